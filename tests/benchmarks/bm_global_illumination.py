"""Derivatives of global illumination:  python tests/benchmarks/bm_global_illumination.py [--quick] [--out FOLDER]

`prb_edge` and Mitsuba's `prb_projective`; the cost of deeper paths; convergence (figure 8 of Li et al. 2018); and
scalar derivatives against redner, the code of that paper, whose numbers are constants here.
"""

from __future__ import annotations

import json
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import numpy as np
from _bench import (
    EQUAL_TIME_SPP,
    Benchmark,
    Problem,
    Settings,
    at_resolution,
    case_text,
    cases,
    duration,
    equal_time_table,
    figure,
    main,
    median_seconds,
    outliers_text,
    plot_errors,
    save,
    say,
    table,
)

OURS, PEER = "prb_edge", "prb_projective"

NOTES = {
    "cornell_box": "A box moves in Mitsuba's Cornell box.",
    "bunny_box": "A bunny moves in a box, paths of up to 7 segments.",
    "open_air": "A cube above a floor under the sky alone.",
    "mirrored_sphere": "A rough mirror shows a sphere.",
}
#: The peer takes up to a minute for a derivative of these, however few its samples.
SLOW = ("cornell_box", "bunny_box")
DEPTHS = (2, 3, 4, 6, 8)


def methods(depth: int) -> dict[str, dict]:
    return {name: {"type": name, "max_depth": depth} for name in (OURS, PEER)}


def against_reference(name: str, settings: Settings, _: Path) -> dict[str, Any]:
    problem = Problem.of_case(name, methods(cases.case(name).max_depth))
    peer_spp = (4,) if name in SLOW else (4, 64)
    if name in SLOW:
        settings = replace(settings, calls=(4, 1))
    rows = []
    for spp in settings.pick((4, 16, 64, 256, 1024)):
        rows += problem.rows(spp, (OURS, PEER) if spp in peer_spp else (OURS,), settings)
    return {
        "rows": rows,
        "equal_time": [problem.equal_time(OURS, PEER, rows, settings)],
        "outliers": problem.outliers(OURS, settings),
        "reference": problem.facts(),
    }


def depth(settings: Settings, _: Path) -> dict[str, Any]:
    """Time of an image and of a derivative image."""
    scene, found = cases.cornell_box(), []
    for d in settings.pick(DEPTHS, quick=2):
        problem = Problem("cornell_box", scene, cases.BOX_SIDE, {OURS: {"type": OURS, "max_depth": d}})
        path = mi.load_dict({"type": "path", "max_depth": d})
        found.append(
            {
                "depth": d,
                "image": median_seconds(
                    lambda seed, path=path: mi.render(scene, integrator=path, spp=64, seed=seed), 3
                ),
                "derivative": median_seconds(lambda seed, p=problem: p.derivative(OURS, 64, seed), 3),
            }
        )
    return {"depths": found}


def convergence(settings: Settings, folder: Path) -> dict[str, Any]:
    """Derivative images at more and more samples per pixel."""
    from rimlight.pictures import Panel, symmetric_limit, write_panels

    name = "bunny_box" if cases.REDNER.exists() else "cornell_box"
    case = cases.case(name)
    scene = at_resolution(case.scene, 96)
    problem = Problem(name, scene, case.motion, methods(case.max_depth))
    counts = settings.pick((1, 4, 16, 64, 256), quick=3)
    panels = [Panel(np.array(mi.render(scene, integrator=problem.integrators[OURS], spp=256)), "image")]
    problem.timed(OURS, 1, 0)
    for spp in counts:
        image, seconds = problem.timed(OURS, spp, 1)
        panels.append(Panel(image, f"{spp} spp, {duration(seconds)}", "derivative"))
    limit = symmetric_limit([panels[-1].image], 97)
    write_panels(folder / "global_illumination_convergence.png", panels, unit="scene unit", limit=limit)
    return {"scene": name}


# ---------------------- redner ----------------------


#: (scene, resolution): redner's standard deviation, mean and backward CPU seconds at 4 samples per pixel, on one core;
#: and the truth by finite differences. Measured once, on another machine than the rest.
REDNER = {
    ("two_triangles", 64): (7.3, 1.6, 0.043, -7.3),
    ("shadow_blocker", 64): (175, 47, 0.037, 47),
    ("shadow_blocker", 256): (760, 750, 0.82, 756),
    ("shadow_glossy", 64): (31, 58, 0.075, -0.4),
    ("shadow_glossy", 256): (122, 1053, 1.34, -6),
    ("bunny_box", 64): (437, -32, 0.51, -68),
    ("bunny_box", 256): (2268, -630, 8.9, -1091),
}
#: Finite differences of the shadow of the blocker with many more samples: 801 ± 13 at 256 × 256 pixels.
BETTER = {("shadow_blocker", 64): 801 / 16, ("shadow_blocker", 256): 801}


def redner_scene(name: str, res: int) -> tuple[mi.Scene, dict[str, Any]]:
    """A scene of redner's tests, at the start pose."""
    scene = json.loads(cases.REDNER.read_text())["scenes"][name]
    view, objects = scene["camera"], {}
    for shape in scene["shapes"]:
        material = scene["materials"][shape["material"]]
        conductor = {**cases.conductor(0.02236), "distribution": "beckmann"}
        props = {"bsdf": cases.diffuse(*material["reflectance"]) if material["type"] == "diffuse" else conductor}
        if "emission_radiance" in shape:
            props["emitter"] = cases.light(*shape["emission_radiance"])
        if "ply" in shape:
            objects[shape["name"]] = {"type": "ply", "filename": str(cases.REDNER.parent / shape["ply"]), **props}
        else:
            objects[shape["name"]] = cases.mesh(shape["name"], shape["vertices"], shape["indices"], **props)
    film = cases.film(width=res, height=res)
    sensor = cases.camera(view["origin"], view["target"], film=film, fov=view["fov_deg"], near_clip=view["near"])
    return cases.scene(sensor=sensor, **objects), scene


def redner(name: str, settings: Settings, _: Path) -> dict[str, Any]:
    """The derivative of the sum of the image, by `render_backward`: what redner's tests do. On one core."""
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        return {"scenes": _redner(name, settings)}
    finally:
        dr.set_thread_count(threads)


def _redner(name: str, settings: Settings) -> list[dict[str, Any]]:
    found = []
    for (scene, res), (std, mean, seconds, truth) in REDNER.items():
        if scene != name or (settings.quick and res > 64):
            continue
        truths = [truth, BETTER.get((name, res))]
        theirs = {"std": std, "mean": mean, "cpu": seconds}
        theirs["mse"] = [None if t is None else std**2 + (mean - t) ** 2 for t in truths]
        ours = _sum_derivative(
            name, res, 6 if settings.quick else 64 if res == 64 else 5 if name == "bunny_box" else 16
        )
        values = np.array(ours.pop("values"))
        ours["mse"] = [None if t is None else float(((values - t) ** 2).mean()) for t in truths]
        found.append({"scene": name, "res": res, "truths": truths, "redner": theirs, "ours": ours})
        say(f"{name} {res}: {found[-1]}")
    return found


def _sum_derivative(name: str, res: int, seeds: int) -> dict[str, Any]:
    """Values of many seeds; median CPU and wall seconds, of a plain call and of a frozen one."""
    scene, facts = redner_scene(name, res)
    longest = facts["max_bounces"] + 1
    integrator = mi.load_dict({"type": OURS, "max_depth": longest} if longest > 2 else {"type": "direct_edge"})
    params, key = mi.traverse(scene), facts["moved_shape"] + ".vertex_positions"
    ones = dr.ones(mi.TensorXf, (res, res, 3))
    # Not in NumPy's memory, for frozen functions.
    initial = mi.Float(params[key]) * dr.opaque(mi.Float, 1)
    dr.eval(initial)

    def backward(scene, integrator, ones, seed):
        integrator.render_backward(scene, mi.traverse(scene), ones, seed=seed, spp=4)

    frozen = dr.freeze(backward, state_fn=lambda scene, integrator, *_: integrator.find_boundaries(scene))

    def run(step, seed) -> tuple[float, float, float]:
        value = mi.Float(initial)
        dr.enable_grad(value)
        params[key] = value
        params.update()
        dr.eval(value)
        dr.sync_thread()
        seed = dr.opaque(mi.UInt32, seed)
        cpu, wall = time.process_time(), time.perf_counter()
        step(scene, integrator, ones, seed)
        dr.eval(dr.grad(params[key]))
        dr.sync_thread()
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        gradient = np.array(dr.grad(params[key])).reshape(-1, 3)
        return float((gradient @ np.array(facts["moved_axis"], float)).sum()), cpu, wall

    run(backward, 0)
    plain = np.array([run(backward, seed) for seed in range(seeds)])
    result = {"values": plain[:, 0].tolist(), "mean": plain[:, 0].mean(), "std": plain[:, 0].std(ddof=1)}
    result |= {"seeds": seeds, "cpu": np.median(plain[:, 1]), "wall": np.median(plain[:, 2])}
    for seed in range(2):
        run(frozen, seed)
    replay = np.array([run(frozen, seed) for seed in range(max(3, seeds // 4))])
    result |= {"frozen_cpu": np.median(replay[:, 1]), "frozen_wall": np.median(replay[:, 2])}
    result |= {"frozen_recordings": frozen.n_recordings, "frozen_mean": replay[:, 0].mean()}
    return {k: v if isinstance(v, list) else float(v) for k, v in result.items()}


# ---------------------- Report ----------------------


def report(found: dict[str, Any]) -> list[str]:
    lines = [f"32 × 32 pixels, at the time that the peer needs for {EQUAL_TIME_SPP} samples per pixel:"]
    lines += equal_time_table([e for name in NOTES if name in found for e in found[name]["equal_time"]])
    if "depth" in found:
        lines += [
            "Longer paths: the Cornell box, 64 samples per pixel.",
            *table(
                {
                    "max. depth": lambda r: r["depth"],
                    "image (`path`)": lambda r: duration(r["image"]),
                    f"derivative (`{OURS}`)": lambda r: duration(r["derivative"]),
                    "ratio": lambda r: f"{r['derivative'] / r['image']:.1f}",
                },
                found["depth"]["depths"],
            ),
        ]
    compared = [s for key, case in found.items() if key.startswith("redner_") for s in case["scenes"]]
    if compared:
        lines += _redner_text(compared)
    lines += outliers_text(found[name] for name in NOTES if name in found)
    for name in NOTES:
        if name in found:
            lines += case_text(name, found[name], NOTES[name])
    return lines


def _redner_text(scenes: list[dict[str, Any]]) -> list[str]:
    both = lambda mse: " / ".join(f"{x:.3g}" for x in mse if x is not None)
    efficiency = lambda s, time: " / ".join(
        f"{a * s['redner']['cpu'] / (b * s['ours'][time]):.2g}"
        for a, b in zip(s["redner"]["mse"], s["ours"]["mse"], strict=True)
        if a is not None
    )
    return [
        "**redner**, the code of Li et al. 2018: derivative of the sum of all pixels as a shape moves along x, 4 "
        "samples per pixel, its tests' start poses. Times are CPU seconds of the backward pass, on one core. redner's "
        "numbers are constants, measured once on another machine: their ratio to ours is rough. The truths are finite "
        "differences. For the shadow of the blocker two are given, with an error against each: that which redner was "
        "measured against, 756 ± 11 at 256 × 256 pixels, and one of our own with more samples, 801 ± 13. *Frozen* is "
        "the same derivative in a function that `dr.freeze` has recorded. "
        "Efficiency ratio: (MSE · CPU s) of redner / ours.",
        *table(
            {
                "<scene": lambda s: s["scene"],
                "pixels": lambda s: f"{s['res']}²",
                "truth": lambda s: " / ".join(f"{t:.4g}" for t in s["truths"] if t is not None),
                "redner: mean": lambda s: f"{s['redner']['mean']:.4g}",
                "std": lambda s: f"{s['redner']['std']:.3g}",
                "MSE": lambda s: both(s["redner"]["mse"]),
                "CPU s": lambda s: f"{s['redner']['cpu']:.3g}",
                "ours: mean": lambda s: f"{s['ours']['mean']:.4g} ± {s['ours']['std'] / s['ours']['seeds'] ** 0.5:.2g}",
                "std ": lambda s: f"{s['ours']['std']:.3g}",
                "MSE ": lambda s: both(s["ours"]["mse"]),
                "CPU s ": lambda s: f"{s['ours']['cpu']:.3g}",
                "frozen": lambda s: f"{s['ours']['frozen_cpu']:.3g}",
                "efficiency ratio": lambda s: efficiency(s, "cpu"),
                "frozen ": lambda s: efficiency(s, "frozen_cpu"),
            },
            scenes,
        ),
    ]


def plot(found: dict[str, Any], folder: Path) -> None:
    plot_errors({name: found[name] for name in NOTES if name in found}, folder / "global_illumination.png")
    if "depth" not in found:
        return
    made, (axes,) = figure(1, width=5)
    x = [r["depth"] for r in found["depth"]["depths"]]
    for key, label in (("image", "image (path)"), ("derivative", f"derivative ({OURS})")):
        axes.semilogy(x, [r[key] for r in found["depth"]["depths"]], marker="o", label=label)
    axes.set(xlabel="max_depth", ylabel="time (s)")
    axes.legend(fontsize=8)
    save(made, folder / "global_illumination_depth.png")


if __name__ == "__main__":
    main(
        Benchmark(
            name="global_illumination",
            cases={
                **{name: partial(against_reference, name) for name in NOTES},
                "depth": depth,
                "convergence": convergence,
                **{f"redner_{name}": partial(redner, name) for name, res in REDNER if res == 64},
            },
            report=report,
            plot=plot,
            needs={name: cases.REDNER for name in ("bunny_box", *(f"redner_{n}" for n, _ in REDNER))},
            settings=Settings(calls=(16, 2), seconds=2),
        )
    )
