"""Photometric stereo of sets that nobody chose: made from a seed, with what goes wrong in real ones.

    python tests/random_photometric.py --seeds 0 200 --processes 2 --out rows.jsonl      # about a minute a set
    python tests/random_photometric.py --only 17
    python tests/random_photometric.py --table rows.jsonl
    python tests/random_photometric.py --exposures --seeds 1000 1132      # starts only, of sets with 20 lights and more

A set has a shape, one to three materials, 8 to 96 lights and noise, and some of: wrong exposures, wrong lights, images
that are missing, values that are clipped or black, light from all around, a mask with holes or a wrong border, pictures
of 8 bits, decoded from sRGB or not. The result must not be worse than the start, but for `WORSE` degrees.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

# isort: off
import rimlight  # noqa: F401  (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage
# isort: on

from rimlight import ggx
from rimlight.inverse import photometric_stereo as ps
from rimlight.inverse.photometric_stereo import calibration, plausibility, simulation, start
from rimlight.inverse.photometric_stereo.dataset import Dataset, angles
from rimlight.inverse.photometric_stereo.vectors import unit
from rimlight.inverse.targets import srgb_to_linear

#: By how much a result may be worse than its start, mean angular error, degrees.
WORSE = 0.2

#: Sizes and alternations: those of the defaults, but for images of a quarter of the size, of which little is left here.
LEVELS = {"resolutions": (0.5, 1.0), "iterations": (6, 4)}

METALS = ("chrome-steel", "brass", "alum-bronze", "gold-metallic-paint", "silver-paint")


@dataclass
class Row:
    """What became of a set. before, after : mean angular errors, degrees. The rest is as of `Result`."""

    seed: int
    label: str
    faults: list[str] = field(default_factory=list)
    pixels: int = 0
    lights: int = 0
    before: float = np.nan
    after: float = np.nan
    verdict: str = ""
    kind: str = ""
    left_out: dict[str, float] = field(default_factory=dict)
    halves: dict[str, float] = field(default_factory=dict)
    curl: dict[str, float] = field(default_factory=dict)
    taken_back: float = 0.0
    raised: str = ""
    seconds: float = 0.0

    @property
    def holds(self) -> bool:
        return not self.raised and self.after <= self.before + WORSE

    def __str__(self) -> str:
        found = self.raised or f"{self.before:6.2f} -> {self.after:6.2f} {self.verdict:6} {self.kind}"
        shown = lambda pair, factor=1: " ".join(f"{factor * x:.1f}" for x in pair.values())
        judged = f"{shown(self.left_out, 100)}, {shown(self.halves)}, {shown(self.curl)}, {self.taken_back:.0%} back"
        faults = ", ".join(self.faults)
        mark = "" if self.holds else "  WORSE"
        return f"{self.seed:5} {found} [{judged}] {self.seconds:.0f} s: {self.label}; {faults}{mark}"


# ---------------------- Sets ----------------------


def make(seed: int, without: str = "") -> tuple[Dataset, ps.Options, Row]:
    """A set, how it is reconstructed, and a row that says what it is. without : leave out this fault, or all."""
    rng = np.random.default_rng([seed, 71])
    scene = _scene(rng, seed)
    data, _ = simulation.simulate(scene, progress=False)
    faults = []
    for k, (name, chance, fault) in enumerate(FAULTS):
        of_fault = np.random.default_rng([seed, 72, k])
        if without in (name, "all") or of_fault.random() > chance:
            continue
        if (done := fault(data, of_fault)) is not None:
            data = done
            faults.append(name)
    options = ps.Options(
        **LEVELS, brightness=float(rng.choice([0.0, 0.6])), start=str(rng.choice(START)), seed=int(rng.integers(1000))
    )
    label = (
        f"{scene.shape}{' (mould)' if scene.concave else ''} {scene.size}, {scene.bsdf}, {scene.lights} lights to "
        f"{scene.spread:.0f}°, noise {scene.noise:.3f}, depth {scene.max_depth}"
        + (f", LEDs at {scene.led_distance:.1f}" if scene.led_distance else "")
        + f"; {options.start}, brightness {options.brightness}"
    )
    return data, options, Row(seed, label, faults, len(data.values), len(data.lights))


#: Methods of the start, the default more often.
START = ("trimmed", "trimmed", "trimmed", "least squares", "reweighted")


def _scene(rng: np.random.Generator, seed: int) -> simulation.Options:
    number = int(rng.choice([1, 1, 2, 3]))
    near = rng.random() < 0.15
    return simulation.Options(
        shape=str(rng.choice(["sphere", "bowl", "folds", "folds"])),
        concave=bool(rng.random() < 0.2),
        hollow=float(rng.uniform(0.15, 0.5)),
        bsdf="|".join(_material(rng, number > 1) for _ in range(number)),
        lights=int(np.round(np.exp(rng.uniform(np.log(8), np.log(96))))),
        spread=float(rng.uniform(25, 75)),
        led_distance=float(rng.uniform(1.5, 5)) if near else 0.0,
        focal=float(rng.uniform(1.5, 4)) if near or rng.random() < 0.15 else 0.0,
        size=int(rng.integers(28, 45)),
        max_depth=int(rng.integers(2, 6)),
        spp=48,
        noise=float(rng.choice([0, 0.005, 0.01, 0.03])),
        seed=seed,
    )


def _material(rng: np.random.Generator, several: bool) -> str:
    kind = rng.choice(["diffuse", "glaze", "metal", "measured", "glaze" if several else "measured"])
    colour = ",".join(f"{c:.2f}" for c in np.clip(rng.uniform(0.05, 0.85) * rng.uniform(0.4, 1, 3), 0.02, 0.85))
    if kind in ("diffuse", "glaze"):
        return f"{kind}:{colour}"
    return str(rng.choice(METALS if kind == "metal" else list(ggx.read_dictionary()[1])))


# ---------------------- What goes wrong ----------------------


def _pictured(data: Dataset, change: Callable[[np.ndarray], np.ndarray]) -> Dataset:
    """With other pictures. change : of values in [0, about 1]."""
    top = np.quantile(data.values, 0.999) or 1.0
    return replace(data, values=(change(data.values / top) * top).astype(np.float32))


def _exposures(data: Dataset, rng: np.random.Generator) -> Dataset:
    off = np.exp(rng.uniform(0.02, 0.2) * rng.standard_normal(len(data.lights)))
    off[rng.random(len(off)) < rng.uniform(0, 0.8)] = 1
    return replace(data, values=data.values * off[:, None].astype(np.float32))


def _casts(data: Dataset, rng: np.random.Generator) -> Dataset:
    off = np.exp(rng.uniform(0.02, 0.1) * rng.standard_normal((len(data.lights), 3)))
    return replace(data, values=data.values * off.astype(np.float32))


def _wrong_lights(data: Dataset, rng: np.random.Generator) -> Dataset | None:
    """A few are far off."""
    if data.near:
        return None
    lights, count = data.lights.copy(), max(round(0.05 * len(data.lights)), 1)
    wrong = rng.choice(len(lights), count, replace=False)
    lights[wrong] = unit(lights[wrong] + rng.uniform(0.2, 1) * rng.standard_normal((count, 3)))
    lights[:, 2] = np.maximum(lights[:, 2], 0.05)
    return replace(data, lights=unit(lights))


def _inexact_lights(data: Dataset, rng: np.random.Generator) -> Dataset | None:
    """All are a little off."""
    if data.near:
        return None
    return replace(data, lights=unit(data.lights + rng.uniform(0.005, 0.04) * rng.standard_normal(data.lights.shape)))


def _missing(data: Dataset, rng: np.random.Generator) -> Dataset:
    """Lamps that did not light."""
    dark = rng.choice(len(data.lights), max(round(rng.uniform(0, 0.15) * len(data.lights)), 1), replace=False)
    values = data.values.copy()
    values[:, dark] *= np.float32(rng.choice([0, 0.01]))
    return replace(data, values=values)


def _clipped(data: Dataset, rng: np.random.Generator) -> Dataset:
    return _pictured(data, lambda v: np.minimum(v, rng.uniform(0.4, 1)))


def _black(data: Dataset, rng: np.random.Generator) -> Dataset:
    """A floor below which all is 0."""
    floor = rng.uniform(0.005, 0.05)
    return _pictured(data, lambda v: np.where(v < floor, 0, v))


def _ambient(data: Dataset, rng: np.random.Generator) -> Dataset:
    """Light from all around, or of the camera's own black."""
    return _pictured(data, lambda v: v + rng.uniform(0.002, 0.03))


def _border(data: Dataset, rng: np.random.Generator) -> Dataset:
    """Pixels of the background are taken for the object's: dark, and of no normal. Those are not judged."""
    ring = ndimage.binary_dilation(data.mask, iterations=int(rng.integers(1, 3))) & ~data.mask
    mask = data.mask | ring
    old = data.mask[mask]
    values = np.zeros((mask.sum(), *data.values.shape[1:]), np.float32)
    values[old] = data.values
    values[~old] = np.float32(rng.uniform(0, 0.05)) * data.typical * rng.random(values[~old].shape, np.float32)
    truth = np.zeros((mask.sum(), 3))
    truth[old] = data.truth
    return replace(data, mask=mask, values=values, truth=truth)


def _holes(data: Dataset, rng: np.random.Generator) -> Dataset:
    """A mask with holes, and of several pieces."""
    noise = ndimage.gaussian_filter(rng.standard_normal(data.mask.shape), rng.uniform(0.5, 3))
    mask = data.mask & (noise > np.quantile(noise, rng.uniform(0.05, 0.4)))
    kept = mask[data.mask]
    return replace(data, mask=mask, values=data.values[kept], truth=data.truth[kept])


def _8_bits(data: Dataset, rng: np.random.Generator) -> Dataset:
    """Exported from sRGB, and decoded."""
    return _pictured(data, lambda v: srgb_to_linear(np.round(_encoded(v) * 255) / 255))


def _not_decoded(data: Dataset, rng: np.random.Generator) -> Dataset:
    return _pictured(data, lambda v: np.round(_encoded(v) * 255) / 255)


def _encoded(v: np.ndarray) -> np.ndarray:
    v = np.clip(v, 0, 1)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)


FAULTS = (
    ("exposures", 0.35, _exposures),
    ("colour casts", 0.2, _casts),
    ("wrong lights", 0.2, _wrong_lights),
    ("inexact lights", 0.25, _inexact_lights),
    ("missing images", 0.15, _missing),
    ("ambient light", 0.2, _ambient),
    ("clipped", 0.2, _clipped),
    ("black", 0.2, _black),
    ("holes", 0.15, _holes),
    ("border", 0.15, _border),
    ("8 bits", 0.15, _8_bits),
    ("sRGB taken for linear", 0.07, _not_decoded),
)


# ---------------------- Judging ----------------------


def run(seed: int) -> Row:
    began, row = time.time(), Row(seed, "")
    try:
        data, options, row = make(seed)
        known = np.linalg.norm(data.truth, axis=1) > 0.5
        mean = lambda normals: float(angles(normals, data.truth)[known].mean())
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            counts, method = start.counts(data, data, 1.0, options.dark), start.method(data, data, 1.0, options)
            lobes = ggx.read_dictionary()[0]
            row.before = mean(start.guess(data, lobes, counts, options, method).normals)
            found = ps.reconstruct(data, options, progress=False)
        row.after, row.verdict = mean(found.guess.normals), found.verdict
        row.left_out, row.halves, row.curl, row.taken_back = found.left_out, found.halves, found.curl, found.taken_back
        row.kind = ("several" if found.kind.several else "one") + (", coat" if found.kind.coat else "")
        if not np.isfinite(found.depth).all():
            row.raised = "depth is not finite"
    except Exception as error:
        row.raised = f"{type(error).__name__}: {str(error).strip().splitlines()[-1][:160]}"
    row.seconds = time.time() - began
    return row


def exposures(seed: int) -> tuple[float, float] | None:
    """Errors of the start with exposures without a trend, and with what `calibration.with_trend` gives back. None of
    sets with so few lights that no exposures are estimated."""
    if _scene(np.random.default_rng([seed, 71]), seed).lights < calibration.FEWEST:
        return None
    data, options, row = make(seed)
    data = plausibility.checked(data)
    counts, method = start.counts(data, data, 1.0, options.dark), start.method(data, data, 1.0, options)
    lobes = ggx.read_dictionary()[0]
    known, errors, with_trend = np.linalg.norm(data.truth, axis=1) > 0.5, [], calibration.with_trend
    for given_back in (lambda found, *_: found, with_trend):
        calibration.with_trend = given_back
        normals = start.guess(data, lobes, counts, options, method).normals
        errors.append(float(angles(normals, data.truth)[known].mean()))
    print(f"{seed} {errors[0]:6.2f} -> {errors[1]:6.2f}: {row.label}; {', '.join(row.faults)}", flush=True)
    return errors[0], errors[1]


def table(rows: list[dict]) -> str:
    """Of sets with what they have in common, a line each."""
    groups: dict[str, list[dict]] = {"all": rows}
    for low, high in ((8, 15), (16, 39), (40, 96)):
        groups[f"{low} to {high} lights"] = [row for row in rows if low <= row["lights"] <= high]
    material = lambda row: row["label"].split(", ")[1:]
    several = lambda row: "|" in ", ".join(material(row))
    groups["one material"] = [row for row in rows if not several(row)]
    groups["two or three materials"] = [row for row in rows if several(row)]
    for name in ("none of these", *(name for name, _, _ in FAULTS)):
        groups[name] = [row for row in rows if (name in row["faults"] if row["faults"] else name == "none of these")]
    lines = [
        "| sets | number | start: median error | result: median error | start kept | worse by more than 0.2° | "
        "largest loss | errors raised |",
        "|---|" + "---:|" * 7,
    ]
    for name, of_group in groups.items():
        done = [row for row in of_group if not row["raised"]]
        if not done:
            continue
        before, after = (np.array([row[key] for row in done]) for key in ("before", "after"))
        kept = sum(row["verdict"] == "start" for row in done)
        lines.append(
            f"| {name} | {len(of_group)} | {np.median(before):.1f}° | {np.median(after):.1f}° | {kept} | "
            f"{(after > before + WORSE).sum()} | {max((after - before).max(), 0):.2f}° | {len(of_group) - len(done)} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 20), help="first seed, and the one after the last")
    parser.add_argument("--only", type=int, nargs="*", help="these seeds")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--out", type=Path, help="rows as JSON, one a line; seeds that it has are not repeated")
    parser.add_argument("--table", type=Path, nargs="+", help="make a table of such files, and nothing else")
    parser.add_argument("--exposures", action="store_true", help="what a trend of the exposures does to starts")
    args = parser.parse_args()
    if args.table:
        print(table([json.loads(line) for file in args.table for line in file.read_text("utf-8").splitlines()]))
        return
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    dr.set_thread_count(1)  # sets are small: processes make better use of several cores
    seeds = list(args.only or range(*args.seeds))
    if args.out and args.out.exists():
        known = {json.loads(line)["seed"] for line in args.out.read_text("utf-8").splitlines()}
        seeds = [s for s in seeds if s not in known]
    if args.exposures:
        both = np.array([errors for seed in seeds if (errors := exposures(seed)) is not None])
        change = both[:, 1] - both[:, 0]
        print(f"{len(both)} sets, mean {both[:, 0].mean():.2f} -> {both[:, 1].mean():.2f} degrees")
        print(f"{(change < -WORSE).sum()} better and {(change > WORSE).sum()} worse by more than {WORSE}")
        print(f"largest changes {change.min():.2f} and {change.max():.2f}")
        return
    if args.processes > 1:
        command = [sys.executable, __file__, *(["--out", str(args.out)] if args.out else []), "--only"]
        parts = [seeds[k :: args.processes] for k in range(args.processes)]
        running = [subprocess.Popen([*command, *map(str, part)]) for part in parts if part]
        sys.exit(max(p.wait() for p in running))
    bad = []
    for seed in seeds:
        row = run(seed)
        print(row, flush=True)
        bad += [] if row.holds else [seed]
        if args.out:
            with args.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps({**asdict(row), "holds": row.holds}) + "\n")
        dr.flush_malloc_cache()
    print(f"{len(seeds) - len(bad)} of {len(seeds)} sets end no worse than they start; not: {bad}")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
