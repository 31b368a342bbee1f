"""Photometric stereo:  python tests/benchmarks/bm_photometric_stereo.py [--quick] [--only ...]

Two objects of DiLiGenT, with each part of the method switched off in turn, and with published numbers beside; surfaces
that are simulated, whose shape and reflectance are known; and depth in millimetres.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np
from _bench import ROOT, Benchmark, Settings, figure, main, say, table
from matplotlib.colors import Normalize, PowerNorm

from rimlight import ggx, merl_tables
from rimlight.inverse import reflectance
from rimlight.inverse.photometric_stereo import (
    dataset,
    integration,
    least_squares,
    output,
    reconstruction,
    simulation,
)
from rimlight.inverse.photometric_stereo.dataset import Dataset, angles
from rimlight.inverse.photometric_stereo.direct import bsdf_of
from rimlight.inverse.photometric_stereo.reconstruction import Options
from rimlight.inverse.photometric_stereo.refinement import Descent

SHARED = ROOT.parent / "shared"
DILIGENT = SHARED / "data" / "diligent"
FACE = SHARED / "data" / "meshes" / "nefertiti-lowres.obj"
TABLES = SHARED / "tools" / "merl_table.py"

NAME = "photometric_stereo"

#: Mean angular errors as published, degrees: ball, bear; and what the methods need.
PUBLISHED = {
    "IA14": (3.34, 7.11, ""),
    "ST14": (1.74, 6.12, ""),
    "PS-FCN": (2.82, 7.55, "trained"),
    "SCPS-NIR": (1.24, 3.82, "no training set; 16 min on a GPU"),
}

#: Depth of the bear from the camera, mm. The LEDs of its rig are in a plane, for their directions are a regular grid:
#: taken to be that of the camera.
RIG = 1490.0

#: Variants are compared at half size, so that the benchmark takes minutes.
HALF = {"resolutions": (0.25, 0.5), "iterations": (10, 6)}

#: From least squares to the method, adding one part after the other.
BARE = {"reflectance": False, "exposures": False, "shadows": False, "max_depth": 2}
ADDED = {
    "diffuse, with albedos": BARE,
    "+ BSDF": {**BARE, "reflectance": True},
    "+ exposures": {**BARE, "reflectance": True, "exposures": True},
    "+ shadows: without interreflections": {"max_depth": 2},
}

#: The method with one part changed.
CHANGED = {
    "without exposures": {"exposures": False},
    "without BSDF": {"reflectance": False},
    "without albedos": {"albedo": False},
    "without shadows": {"shadows": False},
    "all dark values count (`dark` 0)": {"dark": 0.0},
    "`dark` 0.4": {"dark": 0.4},
    "start: least squares": {"start": "least squares"},
    "at one resolution": {"resolutions": (0.5,), "iterations": (16,)},
    "`brightness` 0.4": {"brightness": 0.4},
    "`brightness` 0.8": {"brightness": 0.8},
}

BLUE, GREY = "dark-blue-paint", "gray-plastic"
MASK = {"shape": str(FACE), "crop": (0.22, 0.355, 0.78, 0.66, 0.74)}

#: Name -> options of the simulation.
SIMULATED = {
    "bowl, dark-blue-paint": {"shape": "bowl", "bsdf": BLUE},
    "bowl, gray-plastic": {"shape": "bowl", "bsdf": GREY},
    "bowl, diffuse 0.7": {"shape": "bowl", "bsdf": "diffuse:0.7,0.7,0.7", "spp": 512},
    "convex mask, gray-plastic": {**MASK, "bsdf": GREY},
    "concave mask, gray-plastic": {**MASK, "concave": True, "bsdf": GREY},
    "concave mask, dark-blue-paint": {**MASK, "concave": True, "bsdf": BLUE},
}

#: Of which reflectance is compared, and of which depth descends.
RECOVERED = ("convex mask, gray-plastic", "concave mask, dark-blue-paint")
DESCENDS = "concave mask, dark-blue-paint"

INCIDENCES, OUTGOING = (0, 20, 40, 60), np.linspace(-85, 85, 341)


# ---------------------- Measuring ----------------------


def options(settings: Settings, **changed: Any) -> Options:
    """The defaults, but for some; in a quick run, with few alternations."""
    found = Options(**changed)
    return dataclasses.replace(found, iterations=(1,) * len(found.iterations)) if settings.quick else found


def run(what: str, data: Dataset, chosen: Options) -> tuple[dict[str, Any], reconstruction.Result]:
    result = reconstruction.reconstruct(data, chosen, progress=False)
    say(f"{what}: {result.error:.3f} degrees, {result.seconds:.1f} s, {len(result.history)} alternations")
    return {"error": result.error, "seconds": result.seconds, "history": result.history}, result


def starts(data: Dataset) -> dict[str, np.ndarray]:
    """Normals without alternations, by method."""
    return {m: least_squares.normals(data.luminance, data.lights, m) for m in least_squares.METHODS}


def errors_of(normals: dict[str, np.ndarray], data: Dataset) -> dict[str, float]:
    return {name: float(angles(n, data.truth).mean()) for name, n in normals.items()}


def read(name: str, settings: Settings) -> Dataset:
    return dataset.read(DILIGENT / f"{name}PNG", images=16 if settings.quick else 0)


def crop(name: str) -> tuple[slice, slice]:
    """Of the images, which are 612 x 512."""
    top, bottom, left, right = map(int, re.findall(r"\d+", (DILIGENT / f"{name}PNG" / "crop.txt").read_text())[:4])
    return np.s_[top:bottom, left:right]


def with_rig(data: Dataset, name: str) -> Dataset:
    """With the camera, and lights at their distance."""
    camera = np.loadtxt(DILIGENT / "bear_depth" / "K.txt")
    camera[:2, 2] -= [part.start for part in crop(name)[::-1]]
    return dataclasses.replace(data, camera=camera, distance=RIG).with_near_lights(RIG)


def real(name: str, settings: Settings, _: Path) -> dict[str, Any]:
    data = read(name, settings)
    found: dict[str, Any] = {"starts": errors_of(starts(data), data)}
    found["full"], result = run(name, data, options(settings))
    found["half"] = [e for e in result.history if e["size"] == HALF["resolutions"][-1]][-1]
    found["near"], near = run(f"{name}, lights at {RIG / 1000:g} m", with_rig(data, name), options(settings))
    if name == "bear":
        normals = {"truth": data.truth, "least squares": starts(data)["least squares"]}
        normals |= {"the defaults": result.guess.normals, "with the rig": near.guess.normals}
        found["depth"] = depths_of_bear(data, normals)
    return found


def parts(name: str, settings: Settings, _: Path) -> dict[str, Any]:
    """Errors of variants."""
    data, found = read(name, settings), {}
    for what, changed in settings.pick((ADDED | CHANGED).items(), quick=2):
        found[what] = run(f"{name}, {what}", data, options(settings, **{**HALF, **changed}))[0]["error"]
    return {"errors": found}


def depths_of_bear(data: Dataset, normals: dict[str, np.ndarray]) -> dict[str, dict[str, list[float]]]:
    """Mean absolute errors, mm, of integrated normals, aligned by a factor and rigidly: by normals, by weights."""
    camera = with_rig(data, "bear").camera
    with np.load(DILIGENT / "bear_depth" / "depth_gt.npz") as file:
        truth = next(a for a in file.values() if a.ndim == 2)[crop("bear")]
    mask = data.mask & np.isfinite(truth) & (truth > 0)
    v, u = np.indices(truth.shape)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ integration.ray_matrix(camera).T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    found = {}
    for name, of in normals.items():
        image = data.image(of)
        cosine = np.maximum(-(image * rays).sum(-1), 0)
        ways = {
            "default": {},
            "`weights` = c²": {"weights": cosine**2},
            "`weights` = 1": {"weights": np.ones(mask.shape)},
            **{f"`bilateral={k}`": {"bilateral": k} for k in (1, 2, 4)},
        }
        found[name] = {}
        for way, more in ways.items():
            depth = integration.integrate(image, mask, camera=camera, **more)
            error = lambda d=depth, **how: integration.depth_error(d, truth, mask, **how)
            found[name][way] = [error(align="scale"), error(align="rigid", camera=camera)]
        say(f"depth of the bear, {name}: {found[name]}")
    return found


@dataclass(frozen=True)
class Truth:
    """A simulated set. depth : (H, W), pixels. bsdf, merl : with which it was made; None where that is no table."""

    data: Dataset
    depth: np.ndarray
    bsdf: mi.BSDF
    merl: np.ndarray | None


def simulate(name: str, settings: Settings) -> Truth:
    chosen = {"spp": 48, "max_depth": 6, **SIMULATED[name]}
    if settings.quick:
        chosen |= {"size": 48, "lights": 16, "spp": 4}
    merl = None
    with tempfile.TemporaryDirectory() as folder:
        if (material := chosen["bsdf"]) in (BLUE, GREY):
            file = Path(folder) / f"{material}.binary"
            subprocess.run([sys.executable, TABLES, material, file], check=True)
            chosen["bsdf"], merl = str(file), merl_tables.read_merl(file)
        data, depth = simulation.simulate(simulation.Options(**chosen), progress=False)
        return Truth(data, depth, simulation.bsdf(chosen["bsdf"]), merl)


def simulated(name: str, settings: Settings, folder: Path) -> dict[str, Any]:
    truth = simulate(name, settings)
    data = truth.data
    normals = starts(data)
    found: dict[str, Any] = {}
    found["full"], full = run(name, data, options(settings, brightness=0))
    found["direct"], direct = run(f"{name}, direct light", data, options(settings, brightness=0, max_depth=2))
    if name.endswith(GREY):
        found["coat"], _ = run(f"{name}, coat", data, options(settings, brightness=0, coat=True))
    found["starts"] = errors_of(normals, data)
    normals |= {"without interreflections": direct.guess.normals, "with interreflections": full.guess.normals}
    write_errors(folder / picture(name, "errors"), data, {k: angles(n, data.truth) for k, n in normals.items()})
    found["section"] = section(data, truth.depth, normals)
    if name in RECOVERED:
        found["bsdf"] = slices(full, truth)
    return found


def section(data: Dataset, truth: np.ndarray, normals: dict[str, np.ndarray]) -> dict[str, Any]:
    """Depth along the longest row of the mask, by normals; and mean absolute errors of depth, pixels."""
    row = int(data.mask.sum(1).argmax())
    columns = np.flatnonzero(data.mask[row])
    rounded = lambda depth: np.round(depth[row, columns], 3).tolist()
    found: dict[str, Any] = {"x": columns.tolist(), "depth": {"truth": rounded(truth)}, "error": {}}
    for name, n in normals.items():
        depth = integration.integrate(data.image(n), data.mask)
        depth += np.median((truth - depth)[data.mask])
        found["depth"][name] = rounded(depth)
        found["error"][name] = integration.depth_error(depth, truth, data.mask)
    return found


def slices(result: reconstruction.Result, truth: Truth) -> dict[str, Any]:
    """f cos θₒ in the plane of incidence, luminance: of the table, of its best fit, as recovered."""
    lobes, _ = ggx.read_dictionary()
    best = reflectance.fit(truth.merl, lobes)
    weights, factor = output.bsdf(result)
    weights = weights * factor
    of = {"table": truth.bsdf, "best fit": bsdf_of(lobes, best), "recovered": bsdf_of(lobes, weights)}
    values = lambda bsdf, i: (output.reflected(bsdf, i, OUTGOING) @ dataset.LUMINANCE).tolist()
    errors = {"best fit": best, "recovered": weights}
    return {
        "slices": {name: {str(i): values(bsdf, i) for i in INCIDENCES} for name, bsdf in of.items()},
        "errors": {name: reflectance.error(truth.merl, lobes, w)._asdict() for name, w in errors.items()},
    }


def descents(settings: Settings, folder: Path) -> dict[str, Any]:
    """Errors of depth, pixels, over the steps: with shadows differentiated, and without."""
    made = simulate(DESCENDS, settings)
    data, truth = made.data, made.depth
    found, maps = {}, {}
    for what, rate in (("depth_rate=0", 0.0), ("shadows differentiated", 0.1)):
        depths: list[np.ndarray] = []
        steps = 2 if settings.quick else 40
        result = reconstruction.reconstruct(
            data,
            options(
                settings,
                brightness=0,
                resolutions=(0.5, 1.0),
                iterations=(10, 4),
                descent=Descent(steps=steps, rate=1e-3, depth_rate=rate),
            ),
            progress=False,
            after=lambda r, depths=depths: depths.append(r.data.image(output.depth(r))),
        )
        aligned = [d + np.median((truth - d)[data.mask]) for d in depths[-steps - 1 :]]
        error = [integration.depth_error(d, truth, data.mask) for d in aligned]
        begun = result.history[-steps - 1]["seconds"]
        found[what] = {"depth": error, "angle": [e["error"] for e in result.history[-steps - 1 :]]}
        found[what]["seconds"] = (result.seconds - begun) / steps
        maps.setdefault("before", (aligned[0] - truth)[data.mask])
        maps[what] = (aligned[-1] - truth)[data.mask]
        say(f"{what}: depth {error[0]:.3f} -> {error[-1]:.3f} pixels, {found[what]['seconds']:.2f} s a step")
    write_depths(folder / f"{NAME}_shadows.png", data, maps)
    return {"descent": found}


# ---------------------- Pictures ----------------------


def picture(name: str, what: str) -> str:
    return f"{NAME}_{re.sub('[^a-z0-9]+', '_', name)}_{what}.png"


def write_errors(path: Path, data: Dataset, maps: dict[str, np.ndarray]) -> None:
    """Maps of angular errors, with one scale."""
    limit = float(np.percentile(np.concatenate(list(maps.values())), 95))
    # By the root, so that small errors show beside large ones
    _write_maps(path, data, maps, "inferno", PowerNorm(0.5, 0, limit), "angular error, degrees", "{:.2f}°")


def write_depths(path: Path, data: Dataset, maps: dict[str, np.ndarray]) -> None:
    """Maps of depth minus truth, with one scale."""
    limit = float(np.percentile(np.abs(np.concatenate(list(maps.values()))), 97))
    _write_maps(path, data, maps, "RdBu_r", Normalize(-limit, limit), "depth − truth, pixels", "{:.2f} pixels")


def _write_maps(path: Path, data: Dataset, maps, colours: str, norm: Normalize, unit: str, mean: str) -> None:
    made, row = figure(len(maps), 2.3, 2.7)
    rows, columns = np.nonzero(data.mask)
    crop = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    for axes, (name, values) in zip(row, maps.items(), strict=True):
        shown = axes.imshow(data.image(values, np.nan)[crop], cmap=colours, norm=norm)
        axes.set_title(f"{name}\n{mean.format(np.abs(values).mean())}", fontsize=9)
        axes.set_axis_off()
    bar = made.colorbar(shown, ax=row, fraction=0.03, pad=0.01, extend="max" if norm.vmin == 0 else "both")
    bar.set_label(unit, fontsize=8)
    bar.ax.tick_params(labelsize=7)
    made.savefig(path)


def plot(found: dict[str, Any], folder: Path) -> None:
    plot_times(found, folder / f"{NAME}.png")
    plot_sections({k: v["section"] for k, v in found.items() if k.startswith("bowl")}, folder / f"{NAME}_bowls.png")
    for name in RECOVERED:
        if name in found:
            plot_bsdf(name, found[name]["bsdf"]["slices"], folder / picture(name, "bsdf"))


def plot_times(found: dict[str, Any], path: Path) -> None:
    made, (axes,) = figure(1, 7.5, 4.2)
    for i, (name, case) in enumerate((n, c) for n, c in found.items() if "full" in c):
        history, colour = case["full"]["history"], f"C{i}"
        axes.plot([e["seconds"] for e in history], [e["error"] for e in history], ".-", linewidth=1.3, label=name)
        for before, after in itertools.pairwise(history):
            if before["size"] != after["size"]:
                axes.plot(after["seconds"], after["error"], "o", color=colour, markersize=7, fillstyle="none")
    axes.set(xlabel="seconds", ylabel="mean angular error (degrees)", yscale="log", xlim=(0, None))
    axes.legend(fontsize=8, ncols=2)
    axes.set_title("Each dot an alternation; circles: from there on, images of twice the width", fontsize=9)
    axes.yaxis.set_major_formatter(lambda y, _: f"{y:g}")
    axes.yaxis.set_minor_formatter(lambda y, _: f"{y:g}" if f"{y:g}"[0] in "235" else "")
    made.savefig(path)


def plot_sections(found: dict[str, Any], path: Path) -> None:
    if not found:
        return
    made, row = figure(len(found), 5.0, 3.4)
    all_depths = np.concatenate([depth for part in found.values() for depth in part["depth"].values()])
    low, high = all_depths.min(), all_depths.max()
    styles = {
        "truth": {"color": "black", "linewidth": 2.5, "alpha": 0.35},
        "trimmed": {"color": "C1", "linestyle": ":"},
        "without interreflections": {"color": "C2", "linestyle": "--"},
        "with interreflections": {"color": "C0"},
    }
    for axes, (name, part) in zip(row, found.items(), strict=True):
        for what, style in styles.items():
            label = what if what == "truth" else f"{what}: {part['error'][what]:.2f} pixels"
            axes.plot(part["x"], part["depth"][what], label=label, **style)
        axes.set(
            title=name, xlabel="column (pixels)", ylabel="depth (pixels)", ylim=(low - 2, high + 0.5 * (high - low))
        )
        axes.legend(fontsize=7.5, loc="upper center")
    made.savefig(path)


def plot_bsdf(name: str, of: dict[str, dict[str, list[float]]], path: Path) -> None:
    made, row = figure(len(INCIDENCES), 2.9, 3.3)
    styles = {"table": "--", "best fit": ":", "recovered": "-"}
    highest = max(max(v) for v in of["table"].values())
    for axes, incidence in zip(row, map(str, INCIDENCES), strict=True):
        for what, style in styles.items():
            axes.plot(OUTGOING, of[what][incidence], style, linewidth=1.4, label=what)
        axes.set(title=f"θᵢ = {incidence}°", xlabel="θₒ (degrees)", yscale="log")
        axes.set_ylim(min(of["table"]["0"][20:-20]) / 3, 1.6 * highest)
    row[0].set_ylabel("f cos θₒ (1/sr)")
    row[0].legend(fontsize=8)
    made.suptitle(name, fontsize=10)
    made.savefig(path)


# ---------------------- Report ----------------------


def report(found: dict[str, Any]) -> list[str]:
    return [
        "<!-- diligent -->",
        *of_diligent({k: (v, found.get(f"{k}, parts")) for k, v in found.items() if k in ("ball", "bear")}),
        "<!-- simulated -->",
        *of_simulated({k: v for k, v in found.items() if k in SIMULATED}),
        "<!-- reflectance -->",
        *of_reflectance({k: v for k, v in found.items() if "bsdf" in v}),
        "<!-- shadows -->",
        *of_shadows(found.get("shadows")),
        "<!-- depth -->",
        *of_depth(found.get("bear")),
        "<!-- end -->",
    ]


def of_diligent(found: dict[str, tuple[dict, dict | None]]) -> list[str]:
    """found : object -> its case, and that of its variants."""
    if not found:
        return []
    rows: list[tuple[str, dict[str, str]]] = []
    add = lambda title, of: rows.append((title, {name: of(*cases) for name, cases in found.items()}))
    variant = lambda what: lambda _, p: f"{p['errors'][what]:.2f}" if p and what in p["errors"] else ""
    for method in least_squares.METHODS:
        add(method, lambda c, _, m=method: f"{c['starts'][m]:.2f}")
    for what in ADDED:
        add(f"half size: {what}", variant(what))
    add("half size: + interreflections, the defaults", lambda c, _: f"{c['half']['error']:.2f}")
    for title, key in (("the defaults", "full"), ("camera, and lights at 1.49 m", "near")):
        add(f"**{title}**", lambda c, _, k=key: f"**{c[k]['error']:.2f}** ({c[k]['seconds']:.0f} s)")
    for what in CHANGED:
        add(f"half size: {what}", variant(what))
    for name, (ball, bear, needs) in PUBLISHED.items():
        published = {"ball": str(ball), "bear": str(bear)}
        rows.append((f"*published: {name}{f' ({needs})' if needs else ''}*", published))
    columns = {"<mean angular error, degrees": lambda r: r[0]}
    return table(columns | {o: lambda r, o=o: r[1][o] for o in found}, [r for r in rows if any(r[1].values())])


def of_simulated(found: dict[str, Any]) -> list[str]:
    if not found:
        return []
    robust = lambda c: min(c["starts"]["trimmed"], c["starts"]["reweighted"])
    columns = {"<mean angular error, degrees": lambda r: r[0]}
    columns |= {m: lambda r, m=m: f"{r[1]['starts'][m]:.2f}" for m in least_squares.METHODS}
    columns |= {
        "direct light only": lambda r: f"{r[1]['direct']['error']:.2f}",
        "the defaults": lambda r: f"**{r[1]['full']['error']:.2f}**",
        "robust start / the defaults": lambda r: f"{robust(r[1]) / r[1]['full']['error']:.1f}",
        "with `coat`": lambda r: f"{r[1]['coat']['error']:.2f}" if "coat" in r[1] else "",
        "depth: direct light only": lambda r: f"{r[1]['section']['error']['without interreflections']:.2f}",
        "depth: the defaults": lambda r: f"{r[1]['section']['error']['with interreflections']:.2f}",
        "time": lambda r: f"{r[1]['full']['seconds']:.0f} s",
    }
    return table(columns, list(found.items()))


def of_reflectance(found: dict[str, Any]) -> list[str]:
    if not found:
        return []
    part = lambda x: f"{100 * x:.1f} %"
    columns = {"<set": lambda r: r[0]}
    for what in ("best fit", "recovered"):
        for key in ("rms", "cost"):
            columns[f"{what}: {key}"] = lambda r, w=what, k=key: part(r[1]["bsdf"]["errors"][w][k])
    return table(columns, list(found.items()))


def of_shadows(case: dict[str, Any] | None) -> list[str]:
    if case is None:
        return []
    columns = {
        "<steps": lambda r: r[0],
        "depth before, pixels": lambda r: f"{r[1]['depth'][0]:.3f}",
        "least": lambda r: f"{min(r[1]['depth']):.3f}",
        "after": lambda r: f"{r[1]['depth'][-1]:.3f}",
        "normals before, degrees": lambda r: f"{r[1]['angle'][0]:.2f}",
        "after ": lambda r: f"{r[1]['angle'][-1]:.2f}",
        "a step": lambda r: f"{r[1]['seconds']:.2f} s",
    }
    return table(columns, list(case["descent"].items()))


def of_depth(case: dict[str, Any] | None) -> list[str]:
    if case is None:
        return []
    rows = [(name, row) for name, row in case["depth"].items()]
    columns = {"<mean absolute error, mm": lambda r: r[0]}
    cell = lambda r, w: " / ".join(f"{error:.2f}" for error in r[1][w])
    return table(columns | {way: lambda r, w=way: cell(r, w) for way in rows[0][1]}, rows)


if __name__ == "__main__":
    main(
        Benchmark(
            name=NAME,
            cases={
                **{name: partial(real, name) for name in ("ball", "bear")},
                **{name: partial(simulated, name) for name in SIMULATED},
                "shadows": descents,
                **{f"{name}, parts": partial(parts, name) for name in ("ball", "bear")},
            },
            report=report,
            plot=plot,
            needs={
                "ball": DILIGENT / "bear_depth",
                "bear": DILIGENT / "bear_depth",
                "ball, parts": DILIGENT / "ballPNG",
                "bear, parts": DILIGENT / "bearPNG",
                **{name: FACE for name in SIMULATED if "mask" in name},
                "shadows": FACE,
                **{f"bowl, {name}": TABLES for name in (BLUE, GREY)},
            },
        )
    )
