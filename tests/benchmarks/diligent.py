"""A table of mean angular errors for a copy of DiLiGenT:

    python tests/benchmarks/diligent.py pmsData --out rows.jsonl
    python tests/benchmarks/diligent.py pmsData --camera K.txt --rig 1490 --out rows.jsonl

The folder is the public one, with `ballPNG`, `bearPNG` and so on, of which all are taken, or `--objects`.
With the intrinsic matrix of the camera and the distance of the lights from the object, mm, there are rows "with
the rig", too. Rows that `--out` has already are not made again.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import re
import subprocess
import time
from pathlib import Path

# isort: off
import rimlight  # noqa: F401  (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np
# isort: on

from rimlight.inverse.photometric_stereo import dataset, least_squares, reconstruction
from rimlight.inverse.photometric_stereo.dataset import Dataset

#: In the order of published tables.
OBJECTS = ("ball", "bear", "buddha", "cat", "cow", "goblet", "harvest", "pot1", "pot2", "reading")

#: Rows, besides the methods of the start.
DEFAULTS, WITH_RIG = "the defaults", "with the rig"


def with_rig(folder: Path, data: Dataset, camera: np.ndarray, away: float) -> Dataset:
    """The camera, and lights in a plane at its distance. A file `crop.txt` tells where cropped images lie."""
    camera = camera.copy()
    if (crop := folder / "crop.txt").is_file():
        top, _, left, _ = map(int, re.findall(r"\d+", crop.read_text("utf-8"))[:4])
        camera[:2, 2] -= left, top
    return dataclasses.replace(data, camera=camera, distance=away).with_near_lights(away)


def rows(folder: Path, camera: np.ndarray | None, rig: float, size: float, known: set[tuple[str, str]]):
    """Dictionaries, one after the other, but those that are known."""
    name = folder.name.removesuffix("PNG")
    data = dataset.read(folder)
    if data.truth is None:
        raise ValueError(f'"{folder}" has no Normal_gt.mat')
    for method in least_squares.METHODS:
        if (name, method) not in known:
            found = least_squares.normals(data.at(size).luminance, data.lights, method)
            yield {"object": name, "row": method, "error": float(np.nanmean(data.at(size).off(found)))}
    sets = {DEFAULTS: data}
    if camera is not None:
        sets[WITH_RIG] = with_rig(folder, data, camera, rig)
    for row, of_row in sets.items():
        if (name, row) not in known:
            began, busy = time.perf_counter(), time.process_time()
            result = reconstruction.reconstruct(of_row.at(size), reconstruction.Options(), progress=False)
            yield {
                "object": name,
                "row": row,
                "error": result.error,
                "verdict": result.verdict,
                "material": dataclasses.astuple(result.kind),
                "taken_back": result.taken_back,
                "seconds": time.perf_counter() - began,
                "seconds_of_processors": time.process_time() - busy,
                "left_out": result.left_out,
                "halves": result.halves,
                "curl": result.curl,
            }


def table(found: list[dict]) -> str:
    names = [name for name in OBJECTS if any(row["object"] == name for row in found)]
    lines = [f"| degrees | {' | '.join(names)} |", "|---|" + "---:|" * len(names)]
    for row in dict.fromkeys(r["row"] for r in found):
        of_row = {r["object"]: r for r in found if r["row"] == row}
        text = lambda r: f"{r['error']:.2f}" + (f" ({r['seconds']:.0f} s)" if "seconds" in r else "")
        lines.append(f"| {row} | {' | '.join(text(of_row[n]) if n in of_row else '' for n in names)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--objects", nargs="*", default=OBJECTS, choices=OBJECTS)
    parser.add_argument("--camera", type=Path, help="intrinsic matrix, 3 x 3, of the whole frame")
    parser.add_argument("--rig", type=float, default=1490.0, help="distance of camera and lights, mm")
    parser.add_argument("--size", type=float, default=1.0, help="of the images: 1, or 1 over a whole number")
    parser.add_argument("--out", type=Path, help="rows as JSON, one a line")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], capture_output=True, text=True, cwd=Path(__file__).parent
    )
    camera = None if args.camera is None else np.loadtxt(args.camera)
    found = []
    if args.out is not None and args.out.exists():
        found = [json.loads(line) for line in args.out.read_text("utf-8").splitlines()]
    folders = [args.folder / f"{name}PNG" for name in args.objects if (args.folder / f"{name}PNG").is_dir()]
    if not folders:
        parser.error(f'"{args.folder}" has no folders such as ballPNG')
    for folder in folders:
        known = {(row["object"], row["row"]) for row in found}
        for row in rows(folder, camera, args.rig, args.size, known):
            found.append(row)
            row |= {"commit": commit.stdout.strip(), "size": args.size, "processors": os.cpu_count()}
            if args.out is not None:
                with args.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
            print(json.dumps(row), flush=True)
    print(table(found))


if __name__ == "__main__":
    main()
