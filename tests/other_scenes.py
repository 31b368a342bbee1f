"""Derivatives of scene files that others have made, with respect to what nobody chose, against finite differences:

python tests/other_scenes.py FOLDER --only bsdf_ --out rows.jsonl

In each scene, the camera moves to its right, and so do shapes that are seen; then numbers change, of materials, lights
and sensors, which are chosen at random. What does not agree is compared once more over a tenth of the step: what jumps
into the frame within a step is no part of the derivative.
"""

from __future__ import annotations

import argparse
import json
import random
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import rimlight  # isort: skip (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

from rimlight.checks import Agreement, Motion, compare, derivative_image, finite_differences  # noqa: E402

#: Width and height of the films, pixels.
RES = 24

#: By how many pixels things move in finite differences; by which part of themselves other numbers change.
PIXELS, PART = 0.04, 0.01

#: Shapes that move, and other numbers that change, of each scene. Of a shape, so many pixels are seen at least.
SHAPES, NUMBERS, SEEN = 2, 2, 8

#: What is no number that one would fit, or has no derivative.
NOT_CHANGED = ("positions", "normals", "texcoords", "to_world", "size", "crop_offset", "clip", "time", "shutter_open")

#: Numbers of sensors that move the image, by how much for a whole film.
OF_FILM = {"principal_point_offset_x": 1.0, "principal_point_offset_y": 1.0}


def load(path: Path) -> mi.Scene:
    """The scene of a file, on a small film."""
    scene = mi.load_file(str(path))
    for i, shape in enumerate(scene.shapes()):
        if not shape.id():
            shape.set_id(f"shape_{i}")
    sensor = scene.sensors()[0]
    sensor.set_id(sensor.id() or "sensor")
    params = mi.traverse(sensor)
    values = {"film.size": [RES, RES], "film.crop_size": [RES, RES], "film.crop_offset": [0, 0]}
    for key, value in values.items():
        if key in params:
            params[key] = value
    params.update()
    return scene


def motions(scene: mi.Scene, rng: random.Random) -> Iterator[tuple[str, list[float], float]]:
    """Parameters, the direction in which each changes, and the step of finite differences."""
    sensor, params = scene.sensors()[0], mi.traverse(scene)
    i = dr.arange(mi.UInt32, RES * RES)
    at = mi.Point2f((i % RES + 0.5) / RES, (i // RES + 0.5) / RES)
    rays, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, at, mi.Point2f(0.5))
    si = scene.ray_intersect(rays)
    seen = np.array(si.is_valid())
    if not seen.any():
        return
    distance = float(np.median(np.array(si.t)[seen]))
    ends = np.array(rays(distance)).reshape(3, RES, RES)
    across = ends[:, RES // 2, RES // 2 + 1] - ends[:, RES // 2, RES // 2]
    pixel = float(np.linalg.norm(across))
    right = (across / pixel).tolist()
    camera = f"{sensor.id()}.to_world"
    if camera in params:
        yield camera, right, PIXELS * pixel
    counts = {s.id(): int(dr.count(si.is_valid() & (si.shape == mi.ShapePtr(s)))[0]) for s in scene.shapes()}
    # Not of what is seen most: floors and walls, between which a gap would open.
    shapes = [name for name, count in sorted(counts.items(), key=lambda item: item[1]) if count >= SEEN][:-1]
    for name in shapes[-SHAPES:]:
        keys = [f"{name}.{k}" for k in ("vertex_positions", "positions", "to_world") if f"{name}.{k}" in params]
        yield from ((key, right, PIXELS * pixel) for key in keys[:1])
    numbers = []
    for key, value in params:
        known = dr.is_diff_v(value) and dr.is_float_v(value) and not any(part in key for part in NOT_CHANGED)
        if known and dr.prod(dr.shape(value)) <= 3:
            numbers.append((key, float(dr.max(dr.abs(dr.ravel(value)))[0])))
    for key, size in rng.sample(numbers, min(NUMBERS, len(numbers))):
        name = key.rpartition(".")[2]
        step = PIXELS / RES * OF_FILM.get(name, size) if name in (*OF_FILM, "x_fov") else PART * (size or 1)
        yield key, [1.0], step


def tested(depth: int) -> mi.Integrator:
    return mi.load_dict({"type": "prb_edge", "max_depth": depth, "rr_depth": 1000})


def warnings(scene: mi.Scene, key: str, depth: int) -> list[str]:
    return list(rimlight.plan(scene, [key], integrator=tested(depth)).limits)


def agreement(scene: mi.Scene, key: str, direction: list[float], step: float, args: argparse.Namespace) -> Agreement:
    integrator = tested(args.depth)
    motion = Motion(scene, key, direction=direction)
    runs = [derivative_image(scene, integrator, motion, spp=args.spp, seed=100 + i) for i in range(args.runs)]
    for part in (1.0, 0.1):
        reference = finite_differences(
            scene, motion, step=part * step, runs=args.runs, spp=args.reference_spp, max_depth=args.depth
        )
        found = compare(np.array(runs), reference)
        if not found.faults(noise=1.0):
            break
    return found


def rows(path: Path, args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One for each parameter."""
    try:
        scene = load(path)
        changes = list(motions(scene, random.Random(path.name)))
    except Exception as error:
        yield {"scene": path.name, "raised": f"{type(error).__name__}: {str(error)[:300]}"}
        return
    for key, direction, step in changes:
        began, row = time.time(), {"scene": path.name, "key": key}
        try:
            found = agreement(scene, key, direction, step, args)
            row |= {"said": str(found), "faults": found.faults(noise=1.0), "warned": warnings(scene, key, args.depth)}
        except Exception as error:
            row |= {"raised": f"{type(error).__name__}: {str(error)[:300]}"}
        yield row | {"seconds": round(time.time() - began)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="files whose names contain this")
    parser.add_argument("--depth", type=int, default=3, help="of the paths")
    parser.add_argument("--spp", type=int, default=128)
    parser.add_argument("--reference-spp", type=int, default=1024, help="of the finite differences")
    parser.add_argument("--runs", type=int, default=8, help="of both")
    parser.add_argument("--out", type=Path, help="rows as JSON, one a line; scenes that it has are not repeated")
    args = parser.parse_args()
    mi.set_log_level(mi.LogLevel.Error)
    known = args.out.read_text().splitlines() if args.out and args.out.exists() else []
    done = {json.loads(line)["scene"] for line in known}
    for path in sorted(args.folder.rglob("*.xml")):
        if args.only not in path.name or path.name in done:
            continue
        for row in rows(path, args):
            print(*(f"{value}" for value in row.values()), flush=True)
            if args.out:
                with args.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")
        dr.flush_malloc_cache()


if __name__ == "__main__":
    main()
