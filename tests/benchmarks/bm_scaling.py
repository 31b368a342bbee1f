"""Cost by number of edges, and of the parts of a derivative:  python tests/benchmarks/bm_scaling.py [--quick]

A bumpy ball of 10² to 10⁶ edges above a floor, under an area light: finding the edges, building and refitting their
tree, derivatives. Then a derivative image against an image, and a frozen step of an optimisation.
"""

from __future__ import annotations

import gc
from functools import partial
from pathlib import Path
from typing import Any

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import numpy as np
from _bench import (
    Benchmark,
    Problem,
    Settings,
    at_resolution,
    bumpy_ball,
    cases,
    duration,
    figure,
    main,
    median_seconds,
    percent,
    save,
    say,
    table,
    timed,
)

from rimlight.edge_sampling import EdgeTree, Geometry, find_edges

OURS = "direct_edge"
RINGS = (4, 13, 41, 129, 408)
RES = 64
SHADING = {
    "smooth": "Its normals are interpolated: only silhouettes are boundaries.",
    "flat": "Its faces are flat: the image jumps at every edge.",
}
AGAINST = ((64, 4), (256, 4), (256, 64))


def ball_above_floor(rings: int, normals: bool = False) -> mi.Scene:
    return cases.scene(
        sensor=cases.camera((0, 3, -6), (0, 0.3, 0)),
        floor=cases.horizontal((0, -1, 0), 3, "floor", bsdf=cases.diffuse(0.5)),
        ball=bumpy_ball(rings, "ball", normals, bsdf=cases.diffuse(0.6, 0.5, 0.4)),
        light=cases.horizontal(
            (1, 4, -1), 0.3, "light", down=True, bsdf=cases.diffuse(0), emitter=cases.light(50, 50, 50)
        ),
    )


def edges(normals: bool, settings: Settings, _: Path) -> dict[str, Any]:
    found = []
    for rings in settings.pick(RINGS, quick=3):
        scene = at_resolution(lambda rings=rings: ball_above_floor(rings, normals), RES)
        motion = {"key": "ball.vertex_positions", "direction": [1, 0.3, 0]}
        problem = Problem("ball", scene, motion, {OURS: {"type": OURS}})
        geometry = Geometry.of(scene)
        edges, find = timed(lambda g=geometry: find_edges(g))
        of_ball = edges.mesh[:, 0] == next(i for i, m in enumerate(geometry.meshes) if m.id() == "ball")
        groups = [g for g in (np.flatnonzero(of_ball), np.flatnonzero(~of_ball)) if len(g)]
        tree, build = timed(lambda g=geometry, e=edges, groups=groups: EdgeTree(g, e, groups))
        positions = dr.detach(geometry.positions())
        refit = median_seconds(lambda _, t=tree, p=positions: t.refit(p), 5)
        row = {"edges": len(edges), "find": find, "build": build, "refit": refit, "bytes": tree.bytes / len(edges)}
        del tree, edges
        for spp, calls in ((4, 12), (64, 4)):
            runs = [problem.timed(OURS, spp, seed) for seed in range(calls + 1)]
            images = np.array([image for image, _ in runs[1:]])
            row[f"first_{spp}"], row[f"seconds_{spp}"] = runs[0][1], float(np.median([t for _, t in runs[1:]]))
            # Of a single derivative image, from the spread between them.
            row[f"noise_{spp}"] = float(np.sqrt(2 / np.pi) * images.std(0, ddof=1).sum() / np.abs(images.mean(0)).sum())
        say(str(row))
        found.append(row)
        del problem, scene, geometry
        gc.collect()
        dr.flush_malloc_cache()
    return {"rows": found}


def launches(function: Any) -> int:
    """Kernels that a call launches."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        timed(function)
        return len(dr.kernel_history([dr.KernelType.JIT]))


def against_image(settings: Settings, _: Path) -> dict[str, Any]:
    """A derivative image against an image by `path`."""
    found = []
    for name, build, motion in (
        ("shadow_blocker", cases.shadow_blocker(), cases.BLOCKER_UP),
        ("two_triangles", cases.two_triangles, cases.vertex("green", 1)),
    ):
        for res, spp in settings.pick(AGAINST):
            problem = Problem(name, at_resolution(build, res), motion, {OURS: {"type": OURS}})
            image = lambda seed, p=problem, spp=spp: mi.render(p.scene, integrator=p.path, spp=spp, seed=seed)
            derivative = lambda seed, p=problem, spp=spp: p.derivative(OURS, spp, seed)
            # In turn, so that both see the same machine.
            times = [(timed(lambda: image(s))[1], timed(lambda: derivative(s))[1]) for s in range(13)]  # noqa: B023
            seconds = np.median(times[3:], axis=0)
            row = {"scene": name, "res": res, "spp": spp, "image": float(seconds[0]), "derivative": float(seconds[1])}
            row["launches"] = {"image": launches(lambda: image(99)), "derivative": launches(lambda: derivative(99))}  # noqa: B023
            say(str(row))
            found.append(row)
    return {"rows": found}


def frozen(settings: Settings, _: Path) -> dict[str, Any]:
    """A step of an optimisation: an image, a loss, its gradient; plain, and frozen."""

    def step(scene, integrator, seed):
        image = mi.render(scene, mi.traverse(scene), integrator=integrator, spp=4, seed=seed)
        loss = dr.mean(dr.square(image - 0.2), axis=None)
        dr.backward(loss)
        return loss.array

    found = []
    for name, build, key in (
        ("shadow_blocker", cases.shadow_blocker(), "blocker.vertex_positions"),
        ("two_triangles", cases.two_triangles, "green.vertex_positions"),
        ("ball of 10⁴ edges", lambda: ball_above_floor(RINGS[2]), "ball.vertex_positions"),
    ):
        scene, integrator = at_resolution(build, RES), mi.load_dict({"type": OURS})
        params = mi.traverse(scene)
        initial = mi.Float(params[key]) * dr.opaque(mi.Float, 1)  # not in NumPy's memory
        dr.eval(initial)
        row = {"scene": name}
        freeze = dr.freeze(step, state_fn=lambda scene, integrator, *_: integrator.find_boundaries(scene))
        for how, function in (("plain", step), ("frozen", freeze)):
            times = []
            for seed in range(12 if settings.quick else 60):
                value = initial + dr.opaque(mi.Float, 1e-3 * seed)
                dr.enable_grad(value)
                params[key] = value

                def whole(function=function, seed=seed):
                    params.update()  # noqa: B023
                    loss = function(scene, integrator, dr.opaque(mi.UInt32, seed))  # noqa: B023
                    return loss, dr.grad(params[key])  # noqa: B023

                times.append(timed(whole)[1])
            row[how], row[f"{how}_fastest"] = float(np.median(times[5:])), float(min(times[5:]))
        row["recordings"] = freeze.n_recordings
        say(str(row))
        found.append(row)
    return {"rows": found}


def report(found: dict[str, Any]) -> list[str]:
    lines = []
    for name, what in SHADING.items():
        if name not in found:
            continue
        lines += [
            f"A ball of more and more edges moves above a floor, under a light; {RES} × {RES} pixels. {what} "
            "**noise**: of a single derivative image, as relative L1, from the spread between seeds.",
            *table(
                {
                    "edges": lambda r: f"{r['edges']:,}",
                    "find edges": lambda r: duration(r["find"]),
                    "build tree": lambda r: duration(r["build"]),
                    "refit": lambda r: duration(r["refit"]),
                    "bytes per edge": lambda r: f"{r['bytes']:.0f}",
                    "4 spp": lambda r: duration(r["seconds_4"]),
                    "noise": lambda r: percent(r["noise_4"]),
                    "64 spp": lambda r: duration(r["seconds_64"]),
                    "noise ": lambda r: percent(r["noise_64"]),
                },
                found[name]["rows"],
            ),
        ]
    if "against_image" in found:
        lines += [
            f"A derivative image by `{OURS}` against an image by `path`, which reaches as deep; and how many kernels "
            "they launch.",
            *table(
                {
                    "<scene": lambda r: r["scene"],
                    "pixels": lambda r: f"{r['res']}²",
                    "spp": lambda r: r["spp"],
                    "image": lambda r: duration(r["image"]),
                    "derivative": lambda r: duration(r["derivative"]),
                    "ratio": lambda r: f"{r['derivative'] / r['image']:.1f}",
                    "launches: image": lambda r: r["launches"]["image"],
                    "derivative ": lambda r: r["launches"]["derivative"],
                },
                found["against_image"]["rows"],
            ),
        ]
    if "frozen" in found:
        lines += [
            f"A step of an optimisation with `{OURS}` (update of the scene, image, loss, gradient): {RES} × {RES} "
            "pixels, 4 samples per pixel.",
            *table(
                {
                    "<scene": lambda r: r["scene"],
                    "plain": lambda r: duration(r["plain"]),
                    "frozen": lambda r: duration(r["frozen"]),
                    "frozen, fastest": lambda r: duration(r["frozen_fastest"]),
                },
                found["frozen"]["rows"],
            ),
        ]
    return lines


def plot(found: dict[str, Any], folder: Path) -> None:
    made, (host, time, noise) = figure(3)
    for name, line in (("smooth", "-"), ("flat", "--")):
        rows = found[name]["rows"] if name in found else []
        x = [r["edges"] for r in rows]
        for key, label in (("find", "find edges"), ("build", "build tree"), ("refit", "refit")):
            if name == "smooth":
                host.loglog(x, [r[key] for r in rows], marker="o", label=label)
        for spp, colour in ((4, "C0"), (64, "C1")):
            style = {"marker": "o", "linestyle": line, "color": colour, "label": f"{name}, {spp} spp"}
            time.loglog(x, [r[f"seconds_{spp}"] for r in rows], **style)
            noise.loglog(x, [r[f"noise_{spp}"] for r in rows], **style)
    host.set(ylabel="time (s)", title="once, and when vertices move")
    time.set(ylabel="time (s)", title="derivative image")
    noise.set(ylabel="relative L1", title="its noise")
    for axes in (host, time, noise):
        axes.set(xlabel="edges")
        axes.legend(fontsize=8)
    save(made, folder / "scaling.png")


if __name__ == "__main__":
    main(
        Benchmark(
            name="scaling",
            cases={
                "smooth": partial(edges, True),
                "flat": partial(edges, False),
                "against_image": against_image,
                "frozen": frozen,
            },
            report=report,
            plot=plot,
        )
    )
