"""Are runs of photometric stereo that are killed at random times, and resumed, the whole run bit by bit?

    python tests/benchmarks/killed_runs.py FOLDER --kills 10 --seed 0

A run is killed (SIGKILL) after a random time, and resumed, and killed again, until it ends; then another one begins,
until all kills are made. Every result is compared with that of a run that nobody killed, but for times.
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
import time
from pathlib import Path

PROGRAM = [sys.executable, "-m", "rimlight", "ps"]
OBJECT = "--shape folds --bsdf glaze:0.1,0.2,0.5|glaze:0.6,0.5,0.4 --size 28 --lights 16 --spp 8 --noise 0.01"
OPTIONS = "--threads 1 --resolutions 0.5 1 --iterations 2 2 --brightness 0 --tolerance 0"


def content(out: Path) -> dict:
    """All that a run wrote, but for times."""
    metadata = json.loads((out / "metadata.json").read_text("utf-8"))
    for entry in [metadata, *metadata["history"]]:
        entry.pop("seconds")
    files = {file.name: file.read_bytes() for file in out.iterdir()}
    return {**{name: files[name] for name in files if name not in ("metadata.json", "report.html")}, "said": metadata}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a new folder, for the data set and the results")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = random.Random(args.seed)
    subprocess.run([*PROGRAM, "simulate", str(args.folder / "set"), *OBJECT.split()], check=True, capture_output=True)

    def run(out: Path, *, resume: bool = False, limit: float | None = None) -> bool:
        """Does it end, before it is killed?"""
        command = [*PROGRAM, "run", str(args.folder / "set"), "--out", str(out), *OPTIONS.split()]
        try:
            command += ["--resume"] if resume else []
            subprocess.run(command, check=True, capture_output=True, timeout=limit)  # kills what takes longer
        except subprocess.TimeoutExpired:
            return False
        return True

    began = time.time()
    run(args.folder / "whole")
    took, whole = time.time() - began, content(args.folder / "whole")
    kills = results = different = 0
    while kills < args.kills:
        out = args.folder / f"killed_{results}"
        while True:
            limit = rng.uniform(0.1, 1) * took if kills < args.kills else None
            there = any((out / name).exists() for name in ("checkpoint.npz", "metadata.json"))
            if run(out, resume=there, limit=limit):
                break
            kills += 1
            print(f"killed after {limit:.1f} s{', resumed' if there else ''}", flush=True)
        results, same = results + 1, content(out) == whole
        different += not same
        print("ended, the same" if same else "ended, DIFFERENT", flush=True)
    same = results - different
    print(f"{kills} kills; {same} of {results} results are those of the whole run, which took {took:.0f} s")
    sys.exit(bool(different))


if __name__ == "__main__":
    main()
