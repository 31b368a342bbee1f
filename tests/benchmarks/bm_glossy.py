"""Derivatives of what glossy surfaces show:  python tests/benchmarks/bm_glossy.py [--quick] [--out FOLDER]

`direct_edge` and Mitsuba's `direct_projective`, on floors of many roughnesses, and what importance sampling of edges
brings (figure 5 of Li et al. 2018).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import normal_cones
import numpy as np
from _bench import (
    EQUAL_TIME_SPP,
    Benchmark,
    Problem,
    Settings,
    at_resolution,
    bumpy_ball,
    case_text,
    cases,
    duration,
    equal_time_table,
    figure,
    main,
    median_seconds,
    outliers_text,
    percent,
    plot_errors,
    save,
    say,
    table,
)

from rimlight.edge_sampling import Geometry, find_edges
from rimlight.edge_sampling.choice.edge_tree import EdgeTree
from rimlight.edge_sampling.choice.sampling import EdgeSample, Reservoir, sample_edge
from rimlight.edge_sampling.choice.views import Lobe, View

OURS, PEER = "direct_edge", "direct_projective"
METHODS = {OURS: {"type": OURS}, PEER: {"type": PEER}}

NOTES = {
    "glossy_receiver": "A floor of roughness 0.01 mirrors a wide light, and a slanted blocker in front of it.",
    "mirror_receiver": "The same with roughness 0.0005.",
}
#: The peer takes about as long for one sample as for 64.
PEER_SPP = {"glossy_receiver": (4, 64), "mirror_receiver": (4,)}
ROUGHNESS = (0.0005, 0.003, 0.02, 0.1, 0.3)
PICTURE_RES, PICTURE_SPP, PICTURE_SECONDS = 128, 16, 4.0
BUNNY = cases.REDNER.parent / "redner" / "bunny_box_bunny_target.ply"
CHOICES = ("uniformly", "by normal cones", "without lobes", "by importance")
#: From where single choices are judged: radii around the middle of a mesh, and points at each.
DISTANCES = {"far": 4.0, "near": 1.15}
POINTS = 18


def against_reference(name: str, settings: Settings, _: Path) -> dict[str, Any]:
    problem = Problem.of_case(name, METHODS)
    rows = []
    for spp in settings.pick((4, 16, 64, 256, 1024)):
        rows += problem.rows(spp, (OURS, PEER) if spp in PEER_SPP[name] else (OURS,), settings)
    return {
        "rows": rows,
        "equal_time": [problem.equal_time(OURS, PEER, rows, settings)],
        "outliers": problem.outliers(OURS, settings),
        "reference": problem.facts(),
    }


def roughness(settings: Settings, _: Path) -> dict[str, Any]:
    """Time and noise at a fixed number of samples per pixel; the peer's are in `against_reference`."""
    found = []
    for α in settings.pick(ROUGHNESS, quick=2):
        scene = cases.glossy_receiver(α)()
        problem = Problem(f"roughness {α}", scene, cases.BLOCKER_SIDE, {OURS: METHODS[OURS]})
        problem.truth, _error = problem.mean_of(OURS, 1024, range(1000, 1004 if settings.quick else 1008))
        for spp in (4, 64):
            found.append({"roughness": α, **vars(problem.rows(spp, (OURS,), settings)[0])})
    return {"rows": found}


# ---------------------- With and without importance sampling of edges ----------------------


def many_edges() -> mi.Mesh:
    """A closed mesh: a bunny, or a bumpy ball."""
    if BUNNY.exists():
        return mi.load_dict({"type": "ply", "filename": str(BUNNY)})
    return bumpy_ball(64, "object")


def mirrored_object() -> mi.Scene:
    """A rough mirror that shows a closed mesh of many edges."""
    shape = many_edges()
    p, faces = (np.array(mi.traverse(shape)[key]).reshape(-1, 3) for key in ("vertex_positions", "faces"))
    p = (p - (p.min(0) + p.max(0)) / 2) / np.ptp(p, axis=0).max() * 1.5 + np.array([0.1, 1.9, 0.9])
    return cases.scene(
        sensor=cases.camera((0, 2, -4), (0, -2, 0)),
        floor=cases.horizontal((0, 0, 0), 4, "floor", bsdf=cases.conductor(0.03)),
        object=cases.mesh("object", p, faces, bsdf=cases.diffuse(0.7, 0.5, 0.4)),
        back=cases.quad([-3, 0, 4], [0, 12, 0], [6, 0, 0], "back", bsdf=cases.diffuse(0), emitter=cases.light(1, 1, 1)),
    )


@contextlib.contextmanager
def edges_chosen(how: str) -> Iterator[None]:
    """Replace the choice of edges: "uniformly" by length, "by normal cones" instead of moments, "without lobes" by the
    tree without the BSDF's lobes."""
    module = import_module("rimlight.edge_sampling.choice.sampling")
    boundary = import_module("rimlight.edge_sampling.boundaries.shading_boundary").ShadingBoundary
    with contextlib.ExitStack() as stack:
        patch = lambda *args: stack.enter_context(mock.patch.object(*args))
        if how == "uniformly":
            patch(module, "importance", lambda node, *_: node.always + node.silhouettes)
            patch(module, "edge_importance", lambda slot, *_: dr.norm(slot.b - slot.a))
            patch(module, "sample_point", lambda *args: (args[-1], mi.Float(1)))
        if how == "by normal cones":
            for replacement in normal_cones.replacements():
                patch(*replacement)
        if how in ("uniformly", "without lobes"):
            patch(boundary, "_lobe", lambda *_: Lobe(mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(1)))
        yield


def equal_time_picture(settings: Settings, folder: Path) -> dict[str, Any]:
    """One picture for each way to choose edges, all in the same time."""
    from rimlight.pictures import Panel, symmetric_limit, write_panels

    scene = at_resolution(mirrored_object, PICTURE_RES)
    motion = {"key": "object.vertex_positions", "direction": [1, 0, 0]}
    # One boundary only: as seen from points.
    problem = Problem("mirrored object", scene, motion, {OURS: METHODS[OURS]})
    problem.truth, error = problem.mean_of(OURS, 128, range(1000, 1004 if settings.quick else 1010))
    panels, found = [Panel(np.array(mi.render(scene, spp=256, integrator=problem.path)), "image")], []
    for how in CHOICES:
        with edges_chosen(how):
            one = median_seconds(lambda seed: problem.derivative(OURS, PICTURE_SPP, seed), 3)
            spp, renders = PICTURE_SPP, max(1, round((0.3 if settings.quick else PICTURE_SECONDS) / one))
            images = [problem.timed(OURS, spp, seed) for seed in range(renders * 2)]
        seconds = sum(t for _, t in images) / 2
        means = np.array([i for i, _ in images]).reshape(2, renders, *problem.truth.shape).mean(1)
        say(f"{how}: {renders} × {spp} spp")
        l1 = float(np.mean([problem.relative_l1(m) for m in means]))
        found.append({"how": how, "spp": spp, "renders": renders, "seconds": seconds, "relative_l1": l1})
        found[-1]["efficiency"] = 1 / (problem.mse(means) * seconds)
        caption = f"edges chosen {how}\n{spp * renders} spp, {duration(seconds)}, error {percent(l1)}"
        panels.append(Panel(means[0], caption, "derivative"))
    panels.append(Panel(problem.truth, "mean of many renders", "derivative"))
    limit = symmetric_limit([problem.truth], 99)
    write_panels(folder / "glossy_choice.png", panels, unit="scene unit", limit=limit)
    edges = len(problem.integrators[OURS].search.edges)
    noise = np.sqrt(2 / np.pi) * error.sum() / np.abs(problem.truth).sum()
    return {"choices": found, "edges": edges, "truth_error": noise}


def single_choices(settings: Settings, _: Path) -> dict[str, Any]:
    """Weights of edges that are chosen from random points around a mesh: length over distance, over density."""
    geometry = Geometry((many_edges(),), ())
    edges, positions = find_edges(geometry), geometry.positions()
    p = geometry.host_positions()
    middle = p.mean(0)
    radius, found = np.linalg.norm(p - middle, axis=1).max(), []
    for how, candidates in (("uniformly", 1), ("by normal cones", 1), ("by importance", 1), ("by importance", 4)):
        with edges_chosen(how):
            tree = EdgeTree(geometry, edges, [np.arange(len(edges))])
            tree.refit(positions)
            row, random = {"how": how, "candidates": candidates}, np.random.default_rng(0)
            for name, distance in DISTANCES.items():
                d = random.normal(size=(3 if settings.quick else POINTS, 3))
                eyes = middle + distance * radius * d / np.linalg.norm(d, axis=1, keepdims=True)
                weights = np.array([_weights(tree, positions, eye, candidates, seed) for seed, eye in enumerate(eyes)])
                row[name] = float(((weights**2).mean(1) / weights.mean(1) ** 2).mean())
                row[f"{name}_hits"] = float((weights > 0).mean())
            found.append(row)
    return {"edges": len(edges), "points": len(d), "choices": found}


def _weights(
    tree: EdgeTree, positions: mi.Float, eye: np.ndarray, candidates: int, seed: int, count: int = 200_000
) -> np.ndarray:
    """Of edges as seen from a point; 0 where they are no boundaries. Of several candidates, one is kept."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    eye = mi.Point3f(*(dr.opaque(mi.Float, float(x), count) for x in eye))
    view = View(mi.Vector3f(eye - tree.centre), mi.Vector3f(0), dr.full(mi.Float, 1, count), [])
    choice, active = sampler.next_1d(), dr.full(mi.Bool, True, count)

    def draw(k: mi.Float | int, sampler: mi.Sampler) -> EdgeSample:
        part = (choice + k) / candidates
        return sample_edge(tree, view, sampler, [1], choice=part, active=active)

    def length_by_distance(e: EdgeSample) -> mi.Float:
        a, b = tree.device_edges.end_points(positions, e.edge)
        return dr.norm(b - a) / dr.norm(dr.lerp(a, b, e.t) - eye)

    reservoir = dr.zeros(Reservoir, count)
    for k in range(candidates):
        e = draw(k, sampler)
        reservoir, _ = reservoir.take(e, length_by_distance(e), sampler, active)
    e = reservoir.kept(candidates)
    hit = (e.density > 0) & tree.device_edges.is_boundary(positions, e.edge, eye)
    return np.array(dr.select(hit, length_by_distance(e) / e.density, 0), float)


# ---------------------- Report ----------------------


def report(found: dict[str, Any]) -> list[str]:
    lines = [f"32 × 32 pixels, at the time that the peer needs for {EQUAL_TIME_SPP} samples per pixel:"]
    lines += equal_time_table([e for name in NOTES if name in found for e in found[name]["equal_time"]])
    if "choice" in found:
        case = found["choice"]
        best = case["choices"][-1]["efficiency"]
        lines += [
            f"A mesh that a rough mirror shows, {case['edges']} edges in the scene, {PICTURE_RES} × {PICTURE_RES} "
            "pixels, the same time for each way to choose an edge. The truth is a mean of many renders with importance "
            f"sampling; its own noise is {percent(case['truth_error'])}. *By normal cones*: a node, or an edge in a "
            "leaf, counts with its whole length, unless a cone around its face normals shows that it has no "
            "silhouettes. The weights of directions are the same. In all of them, one of four edges is kept, in "
            "proportion to what it contributes if nothing hides it.",
            *table(
                {
                    "<edges chosen": lambda c: c["how"],
                    "samples per pixel": lambda c: c["spp"] * c["renders"],
                    "time": lambda c: duration(c["seconds"]),
                    "rel. L1": lambda c: percent(c["relative_l1"]),
                    "efficiency, of the best": lambda c: f"{c['efficiency'] / best:.3g}",
                },
                case["choices"],
            ),
            "",
        ]
    if "single_choices" in found:
        case = found["single_choices"]
        lines += [
            f"Choices judged one by one: a mesh of {case['edges']} edges, seen from {case['points']} random points at "
            f"each of {DISTANCES['far']:g} and {DISTANCES['near']:g} radii around its middle. How many samples are "
            "boundaries as seen from there; and the second moment of length over distance, divided by the density of "
            "the choice, in units of the squared mean (1 is perfect).",
            *table(
                {
                    "<edges chosen": lambda c: c["how"],
                    "candidates": lambda c: c["candidates"],
                    "boundaries, far": lambda c: percent(c["far_hits"]),
                    "near": lambda c: percent(c["near_hits"]),
                    "second moment, far": lambda c: f"{c['far']:.2f}",
                    "near ": lambda c: f"{c['near']:.2f}",
                },
                case["choices"],
            ),
        ]
    if "roughness" in found:
        lines += [
            f"The floor's roughness, `{OURS}`. The truth is a mean of many renders of its own.",
            *table(
                {
                    "roughness": lambda r: r["roughness"],
                    "spp": lambda r: r["spp"],
                    "time": lambda r: duration(r["seconds"]),
                    "rel. L1": lambda r: percent(r["relative_l1"]),
                },
                found["roughness"]["rows"],
            ),
        ]
    lines += outliers_text(found[name] for name in NOTES if name in found)
    for name in NOTES:
        if name in found:
            lines += case_text(name, found[name], NOTES[name])
    return lines


def plot(found: dict[str, Any], folder: Path) -> None:
    plot_errors({name: found[name] for name in NOTES if name in found}, folder / "glossy.png")
    if "roughness" not in found:
        return
    made, (axes,) = figure(1, width=5)
    for spp in (4, 64):
        rows = [r for r in found["roughness"]["rows"] if r["spp"] == spp]
        x, y = ([r[key] for r in rows] for key in ("roughness", "relative_l1"))
        axes.loglog(x, y, marker="o", label=f"{spp} samples per pixel")
    axes.set(xlabel="roughness α of the floor", ylabel="relative L1 error")
    axes.legend(fontsize=8)
    save(made, folder / "glossy_roughness.png")


if __name__ == "__main__":
    main(
        Benchmark(
            name="glossy",
            cases={
                **{name: partial(against_reference, name) for name in NOTES},
                "roughness": roughness,
                "choice": equal_time_picture,
                "single_choices": single_choices,
            },
            report=report,
            plot=plot,
            settings=Settings(calls=(16, 2), seconds=2, trials=2),
        )
    )
