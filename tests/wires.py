"""B-spline curves: wires and hair, which slide, bend and swell, and are passed."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from building import camera, constant, diffuse, film, horizontal, light, quad, scene

LOOK = ((0.6, 1.3, -3.2), (0, 0.55, 0))

#: Two wires: places and radii of their control points.
ARCH = [(-1.3, -0.5, 0.1, 0.1), (-0.9, 0.5, 0.1, 0.1), (-0.3, 1.1, -0.2, 0.1), (0.4, 1.0, 0.2, 0.1)]
ARCH += [(0.9, 0.6, -0.2, 0.1), (1.2, -0.4, -0.3, 0.1)]
HAIR = [(-0.7, 0.2, -0.6, 0.06), (-0.2, 0.4, -0.5, 0.07), (0.2, 0.3, -0.7, 0.05), (0.7, 0.8, -0.4, 0.06)]
HAIR += [(1.1, 0.9, -0.6, 0.05)]
COUNT = len(ARCH) + len(HAIR)


def wires(kind: str = "bsplinecurve") -> dict[str, Any]:
    lines = ["\n".join(" ".join(map(str, point)) for point in wire) for wire in (ARCH, HAIR)]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "wires.txt"
        file.write_text("\n\n".join(lines) + "\n")
        bsdf = mi.load_dict(diffuse(0.8, 0.5, 0.3))
        return mi.load_dict({"type": kind, "filename": str(file), "bsdf": bsdf, "id": "wires"})


def sun() -> dict[str, Any]:
    return {"type": "directional", "direction": [0.4, -1, 0.7], "irradiance": {"type": "rgb", "value": [3, 2.5, 2]}}


def lamp() -> mi.Mesh:
    return horizontal((0.5, 2.6, -0.9), 0.5, "lamp", down=True, bsdf=diffuse(0.0), emitter=light(10, 9, 8))


def before_wall(make: Callable[[], Any], **options: Any) -> Callable[[], mi.Scene]:
    def build() -> mi.Scene:
        floor = horizontal((0, -0.3, 0), 2, "floor", bsdf=diffuse(0.5, 0.6, 0.7, two_sided=True))
        back = quad((-2, -0.3, 1.2), (0, 2, 0), (4, 0, 0), "back", bsdf=diffuse(0.7, 0.5, 0.4, two_sided=True))
        return scene(sensor=camera(*LOOK, **options), wires=wires(), floor=floor, back=back, lamp=make())

    return build


def motion(*direction: float) -> dict[str, Any]:
    """All control points move so, and their radii grow."""
    return {"key": "wires.control_points", "direction": list(direction) * COUNT}


SLIDE, SWELL = motion(1, 0.4, 0.3, 0), motion(0, 0, 0, 1)
_k = np.arange(COUNT)
BEND = {
    "key": "wires.control_points",
    "direction": np.stack([np.sin(_k), np.cos(2 * _k), np.sin(3 * _k), 0.2 * np.cos(_k)], -1).ravel().tolist(),
}
CAMERA = {"key": "sensor.to_world", "direction": [1, 0.3, 0]}
LAMP = {"key": "lamp.vertex_positions", "direction": [1, 0.2, 0.4]}

#: Scene, motion, step, and the depth of the paths.
WIRES = {
    "wires_slide": (before_wall(lamp), SLIDE, 4e-3, 2),
    "wires_swell": (before_wall(constant), SWELL, 2e-3, 2),
    "wires_bend": (before_wall(sun), BEND, 4e-3, 2),
    "wires_camera": (before_wall(sun, film=film("gaussian")), CAMERA, 4e-3, 2),
    "wires_lamp": (before_wall(lamp), LAMP, 4e-3, 3),
    "wires_indirect": (before_wall(lamp), BEND, 4e-3, 3),
}
