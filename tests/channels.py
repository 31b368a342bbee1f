"""Scenes and motions on which derivatives of channels besides light are compared with finite differences.

The references are those of Mitsuba's own `aov`, and of masks that are asked for here:

    python tests/channels.py [NAME ...]

makes them: 8 to 32 runs of 16,384 stratified samples a pixel, a few minutes each on two cores.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

import cases
from building import camera, diffuse, film, scene

from rimlight.checks import FiniteDifferences, Motion, derivative_image, finite_differences
from rimlight.exr import read_exr, write_exr

GEOMETRY = "dd:depth, pp:position, uv:uv, gn:geo_normal, sn:sh_normal"
REST = "al:albedo, du:dp_du, dv:dp_dv, dx:duv_dx, dy:duv_dy"


@dataclass(frozen=True)
class ChannelCase:
    """A derivative of channels. aovs : of Mitsuba's kinds. masks : ids of shapes, whose masks, and alpha, come after
    them. The other fields are those of `cases.Case`; `spp` is a square number."""

    name: str
    scene: Callable[[], mi.Scene]
    motion: dict
    step: float
    aovs: str = GEOMETRY
    masks: tuple[str, ...] = ()
    runs: int = 8
    spp: int = 256
    seeds: int = 8

    @property
    def file(self) -> Path:
        return cases.REFERENCES / f"channels_{self.name}.exr"

    def integrator(self, **options) -> mi.Integrator:
        masks = "".join(f", m{i}:mask:{shape}" for i, shape in enumerate(self.masks)) + ", a:alpha" * bool(self.masks)
        return mi.load_dict({"type": "aov_edge", "aovs": self.aovs + masks, **options})

    def derivatives(self) -> np.ndarray:
        """One image for each seed: (seeds, H, W, C)."""
        scene, integrator = self.scene(), self.integrator()
        motion = Motion(scene, **self.motion)
        images = [derivative_image(scene, integrator, motion, spp=self.spp, seed=i) for i in range(self.seeds)]
        return np.array(images, np.float64)

    def make(self) -> None:
        """Make the reference."""
        scene, integrator = self.scene(), self.integrator()
        of = Reference(scene, self)
        found = finite_differences(
            scene, Motion(scene, **self.motion), step=self.step, runs=self.runs, spp=16384, integrator=of, progress=True
        )
        layers = {}
        for name, part in integrator.layout(found.mean.shape[2]).items():
            for kind in ("mean", "standard_error", "step_error"):
                layer = getattr(found, kind)[..., part]
                layers[f"{name}.{kind}"] = np.pad(
                    layer, ((0, 0), (0, 0), (0, -layer.shape[2] % 3 if layer.shape[2] > 1 else 0))
                )
        write_exr(self.file, layers, {**found.settings, "command": f"python tests/channels.py {self.name}"})

    def reference(self) -> FiniteDifferences:
        """All channels, one behind the other."""
        integrator = self.integrator()
        layers, settings = read_exr(self.file)
        parts = {}
        for kind in ("mean", "standard_error", "step_error"):
            widths = {c.name: len(c.components) for c in integrator.channels}
            parts[kind] = np.concatenate([layers[f"{n}.{kind}"][..., :width] for n, width in widths.items()], axis=2)
        return FiniteDifferences(**parts, settings=settings)


class Reference:
    """A sampling integrator: Mitsuba's `aov`, and masks."""

    def __init__(self, scene: mi.Scene, case: ChannelCase):
        self.aov = mi.load_dict({"type": "aov", "aovs": case.aovs})
        self.masks = [next(mi.ShapePtr(s) for s in scene.shapes() if s.id() == mask) for mask in case.masks]
        self.footprint = case.spp**-0.5

    def __str__(self) -> str:
        return f"{self.aov}, {len(self.masks)} masks"

    def aov_names(self) -> list[str]:
        masks = [f"mask{i}" for i in range(len(self.masks) + 1)] if self.masks else []
        return self.aov.aov_names() + masks

    def sample(self, scene, sampler, ray):
        ray.scale_differential(self.footprint)
        L, valid, channels = self.aov.sample(scene, sampler, ray)
        if self.masks:
            si = scene.ray_intersect(ray)
            one = lambda seen: dr.select(seen, mi.Float(1), 0)
            channels = [*channels, *(one(si.is_valid() & (si.shape == m)) for m in self.masks), one(si.is_valid())]
        return L, valid, channels


def wall(size: float) -> dict:
    """Behind the origin, facing the camera."""
    T = mi.ScalarTransform4f
    to_world = T().translate([0, 0, 2]).rotate([0, 1, 0], 180).scale(size)
    return {"type": "rectangle", "to_world": to_world, "bsdf": diffuse(0.3)}


def before_wall(
    thing: Callable[[], dict], sensor: Callable[[], dict] = camera, size: float = 12, **more: dict
) -> Callable[[], mi.Scene]:
    return lambda: scene(sensor=sensor(), thing=thing(), wall=wall(size), **more)


def smooth_ball(sensor: Callable[..., dict] = camera) -> Callable[[], mi.Scene]:
    """A ball of 1,900 triangles with interpolated normals, and texture coordinates with a seam."""
    eye = (0.63, 2.57, -2.1), (0.13, 1.88, 0.5)
    return lambda: scene(sensor=sensor(*eye), sphere=cases.coloured_sphere(True), wall=wall(1.5))


def sphere() -> dict:
    return {"type": "sphere", "bsdf": diffuse(0.5)}


def gaussian(*eye) -> dict:
    return camera(*eye, film=film("gaussian"))


TURN = {"key": "thing.vertex_positions", "rotate": [0.3, 1, 0.2], "pivot": [0.1, 0.2, 0]}
SIDE = {"key": "sphere.vertex_positions", "direction": [1, 0.3, 0.4]}
ROLL = {"key": "thing.to_world", "rotate": [0.3, 1, 0.4], "pivot": [0.4, 0.5, -0.6]}
MASKS = {"masks": ("thing", "wall")}

CASES = [
    ChannelCase("cube_turns", before_wall(cases.textured_cube), TURN, 3e-3, f"{GEOMETRY}, {REST}", runs=16, **MASKS),
    ChannelCase("cube_turns_gaussian", before_wall(cases.textured_cube, gaussian), TURN, 3e-3, runs=16, **MASKS),
    ChannelCase(
        "camera_turns", before_wall(cases.textured_cube), cases.CAMERA_TURN, 5e-4, f"{GEOMETRY}, {REST}", runs=16
    ),
    ChannelCase("ball_moves", smooth_ball(), SIDE, 2e-3, masks=("sphere",)),
    ChannelCase("ball_moves_gaussian", smooth_ball(gaussian), SIDE, 2e-3, masks=("sphere",)),
    ChannelCase("sphere_rolls", before_wall(sphere, size=1.5), ROLL, 3e-3, runs=32, spp=576, **MASKS),
    ChannelCase("bare_cube_turns", before_wall(cases.welded_cube), TURN, 3e-3, "uv:uv"),
]


def case(name: str) -> ChannelCase:
    return next(c for c in CASES if c.name == name)


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    for c in CASES:
        if not sys.argv[1:] or c.name in sys.argv[1:]:
            c.make()
