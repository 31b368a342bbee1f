"""Deliberate faults, one at a time, and which tests notice each:  python tests/mutants.py [--only NUMBER ...] [TEST]

A test that cannot fail proves nothing. Each fault is made in a copy of the project, never in the project itself. The
fast tests run first, and those of `make test` only if none of these fails. They stop at the third that fails, or at
another (`--stop-at`); what no test notices is listed at the end, with exit code 1.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

#: Where `rimlight` and its parts come from.
PACKAGES = {"plugins": "", "edge_sampling": "edge_sampling", "inverse": "inverse", "scenes": "scenes"}

TESTS = (
    "derivatives",
    "invariants",
    "coarse_meshes",
    "coarse_lamps",
    "fine_meshes",
    "stale",
    "direct_edge",
    "prb_edge",
    "random_scenes",
    "aov_edge",
)
FOLDER = "tests/plugins/integrators"


@dataclass(frozen=True)
class Mutant:
    """fault : in words. file : of the project. changes : (text, what takes its place), each occurs once."""

    fault: str
    file: str
    changes: tuple[tuple[str, str], ...]


def mutant(fault: str, file: str, *texts: str) -> Mutant:
    return Mutant(fault, file, tuple(zip(texts[::2], texts[1::2], strict=True)))


TEXTURE_LINES = "edge_sampling/geometry/texture_lines.py"
SEARCH = "plugins/integrators/_search.py"
FOUND = "edge_sampling/boundaries/found.py"
OUTLINES = "edge_sampling/boundaries/film_outlines.py"
SCATTERING = "plugins/transport/scattering.py"
PARAMETRISATION = "edge_sampling/parametrisation.py"
FILM = "edge_sampling/boundaries/film_boundary.py"
SHADOWS = "edge_sampling/boundaries/shadow_boundary.py"
SHADING = "edge_sampling/boundaries/shading_boundary.py"
SILHOUETTES = "edge_sampling/choice/silhouettes.py"
INDIRECT = "edge_sampling/boundaries/indirect_shadows.py"
REPLAY = "plugins/transport/replay.py"

MUTANTS = [
    # ---------------------- A term, 2 % too large ----------------------
    mutant(
        "interior: 2 % too large",
        "plugins/terms/interior.py",
        "value = Sample(mi.Spectrum(found.L * ray_weight), mi.Float(0))",
        "value = Sample(mi.Spectrum(1.02 * found.L * ray_weight), mi.Float(0))",
    ),
    mutant(
        "film boundary: 2 % too large",
        FILM,
        "normal_velocity = dr.dot(points.n_dl, points.velocity)",
        "normal_velocity = 1.02 * dr.dot(points.n_dl, points.velocity)",
    ),
    mutant("shadows from lights: 2 % too large", SHADOWS, "value = jump * dr.dot", "value = 1.02 * jump * dr.dot"),
    mutant("edges from points: 2 % too large", SHADING, "- side * value", "- 1.02 * side * value"),
    mutant(
        "planes of faces: twice as large",
        "edge_sampling/boundaries/face_planes.py",
        "value += jump * dr.select",
        "value += 2 * jump * dr.select",
    ),
    mutant(
        "horizons from points: twice as large",
        "edge_sampling/boundaries/horizons_at_points.py",
        "return weight * jump * dr.select",
        "return 2 * weight * jump * dr.select",
    ),
    mutant(
        "edges from points: density of candidates 2 % off",
        SHADING,
        "e.density *= dr.select(emission,",
        "e.density *= 1.02 * dr.select(emission,",
    ),
    # ---------------------- Signs, sides, velocities ----------------------
    mutant(
        "outlines of grids: across the tangents of triangles",
        "edge_sampling/boundaries/grid_outlines.py",
        "n, dr.select(known, turned, n_dl), active",
        "n, n_dl, active",
    ),
    mutant("film boundary: wrong sign", FILM, "jump -= seen[-1]", "jump += seen[-1]"),
    mutant(
        "film boundary: motion of what is held left out",
        FILM,
        "value += L * dr.dot(points.n_dl, velocity)",
        "value += 0 * L",
    ),
    mutant(
        "passing surfaces: one side of a pixel left out",
        "plugins/terms/passing.py",
        "(sides[0] + sides[1])",
        "(sides[0] + sides[0])",
    ),
    mutant(
        "interior: change of the film area of what is held left out",
        "plugins/terms/interior.py",
        '"stretch": rays.array(stretch)',
        '"stretch": rays.array(0 * stretch + 1)',
    ),
    mutant(
        "edges from points: velocity of what is seen left out",
        SHADING,
        "(edge - held * turning(n_dl, d, valid)",
        "(edge",
    ),
    mutant(
        "shadows from lights: motion of the light not followed",
        SHADOWS,
        "return q\n",
        "return dr.detach(q)\n",
    ),
    mutant(
        "interior: change of area left out",
        PARAMETRISATION,
        "if not self.moving:\n            return area",
        "if True:\n            return area",
    ),
    mutant(
        "interior: rotation of the environment left out",
        SCATTERING,
        "attached = dr.select(on_surface, attached, from_there)",
        "attached = dr.select(on_surface, attached, dr.detach(from_there))",
    ),
    mutant(
        "interior: background stands still when the camera turns",
        PARAMETRISATION,
        "return active & si.is_valid() & ~si.shape.is_mesh() & (dr.abs_dot",
        "return active & ~si.shape.is_mesh() & (dr.abs_dot",
    ),
    mutant(
        "path replay: one vertex short",
        REPLAY,
        "self.active = active & vertex.pi.is_valid() & depths.scatters(vertex.depth)",
        "self.active = active & vertex.pi.is_valid() & depths.scatters(vertex.depth + 1)",
    ),
    # ---------------------- Which edges there are ----------------------
    mutant(
        "edges: not welded",
        "edge_sampling/geometry/edges.py",
        "weld = _weld_equal(point)",
        "weld = np.arange(len(point))",
        "rewelded, tolerance = _weld_close(point, weld, face, sides)",
        "rewelded, tolerance = weld, 0.0",
    ),
    mutant(
        "edges: creases dropped",
        "edge_sampling/geometry/edges.py",
        "kind[~interpolated[mesh0]] = EdgeKind.FLAT",
        "kind[~interpolated[mesh0]] = EdgeKind.SMOOTH",
    ),
    mutant(
        "shadows from lights: only the first light",
        SHADOWS,
        "if self.counts(emitters[i])])",
        "if self.counts(emitters[i])][:1])",
    ),
    mutant(
        "shadows from lights: planes of coarse lamps left out",
        SEARCH,
        "coarse = LampPlanes.of(scene, self.geometry, FRINGE) if coarse else None",
        "coarse = None",
    ),
    mutant(
        "shadows from lights: coarse lamps that are open hide their faces from behind",
        "edge_sampling/boundaries/lamp_planes.py",
        "shadow.active &= self._hidden_below(tracer.scene, light, edge, shadow)",
        "pass",
    ),
    mutant("boxes: of merged meshes, unset", "edge_sampling/geometry/boxes.py", "shape.recompute_bbox()", "pass"),
    mutant("tree of edges: not refitted", FOUND, "self.silhouettes.refit()", "pass"),
    mutant("edges: never found again", SEARCH, "        if same:\n", "        if self._sources is not None:\n"),
    mutant(
        "film boundary: edges that lie behind another outline count",
        FILM,
        "jumps &= ~(chosen.is_edge & hidden)",
        "pass",
    ),
    mutant(
        "film boundary: no horizons of interpolated normals",
        OUTLINES,
        "self.horizons = horizons if len(horizons) else None",
        "self.horizons = None",
    ),
    # ---------------------- Details ----------------------
    mutant(
        "film: samples of the boundary weigh in the filter",
        "plugins/terms/film.py",
        "value, s.wavelengths, 0.0, 0)",
        "value, s.wavelengths, 1.0, 0)",
    ),
    mutant(
        "film boundary: cuts of the near plane stand still",
        OUTLINES,
        "a, b, crossed = cut_by_plane(corners, depth)",
        "a, b, crossed = dr.detach(cut_by_plane(corners, depth))",
    ),
    mutant("film boundary: looks 100 times as far aside", FILM, "(ulps * largest", "(100 * ulps * largest"),
    mutant(
        "edges from points: not shared with the lights' samples",
        SHADING,
        "ours = L * (1 - theirs)",
        "ours = mi.Spectrum(L)",
    ),
    mutant(
        "interior: a lamp lights itself in its own plane",
        PARAMETRISATION,
        "return in_plane(x, y.p) | in_plane(y, x.p)",
        "return mi.Bool(False)",
    ),
    # ---------------------- What random scenes have found ----------------------
    mutant(
        "film boundary: what is not visible has a place on the film",
        FILM,
        "p = dr.select(found.valid, outlines.point(at, chosen, found), eye)",
        "p = outlines.point(at, chosen, found)",
    ),
    mutant(
        "film boundary: looks as near beside glass as beside other meshes",
        FILM,
        "farther = dr.select(chosen.is_edge, beside_edge, 0)",
        "pass",
    ),
    mutant(
        "edges from points: seen from the surface, not from where rays start",
        SHADING,
        "lift = spawn_ray(scene, si, towards).o - si.p",
        "lift = 0 * towards",
    ),
    mutant(
        "film boundary: soft light from elsewhere than a lune counts",
        SCATTERING,
        "active &= ~directions.active | (pdf > 0)",
        "pass",
    ),
    mutant(
        "mirrors from points: the chain moves as if the point that sees it stood still",
        "plugins/terms/mirrored.py",
        "        since = mi.UInt32(1)",
        "        since = mi.UInt32(2)",
    ),
    mutant(
        "edges from points: what a mirror shows of a surface stands still when what looks into it moves",
        "plugins/transport/paths.py",
        "longest = dr.select(onwards.mirrored, dr.minimum(since, before), since)",
        "longest = since",
    ),
    mutant(
        "mirrors from points: they are not looked for",
        "plugins/integrators/_search.py",
        "mirrored = bool(any_mirror and sppi",
        "mirrored = bool(any_mirror and 0",
    ),
    mutant(
        "mirrors and textures: seams of texture coordinates count twice",
        "plugins/transport/film_chains.py",
        "gap |= dr.norm(self.uv - other.uv) > near * per_unit + rounding",
        "pass",
    ),
    mutant(
        "mirrors and textures: lines along edges at which bump maps jump count twice",
        "plugins/transport/film_chains.py",
        "differ &= same_face | shown | ~self.textures.jump_at_edges(a.ray, a.pi, active)",
        "pass",
    ),
    mutant(
        "mirrors and textures: the ray beyond a mapped mirror moves as if nothing mapped its normals",
        "plugins/transport/film_chains.py",
        "        if self._mapped:",
        "        if False:",
    ),
    mutant(
        "mirrors and textures: lamps are dark just inside of their outline",
        "plugins/transport/tracer.py",
        "turn_to_viewer(si, vertex.ray, active & beside_outline)",
        "pass",
    ),
    mutant(
        "shadows: looks 24 times as far aside",
        "edge_sampling/geometry/beside.py",
        "return 0.25 * rounding(p, q)",
        "return 6 * rounding(p, q)",
    ),
    mutant(
        "film boundary: lines in which meshes cut each other count where something hides them",
        "edge_sampling/geometry/device_edges.py",
        "hidden = dr.select(of(self._is_line), hidden_line, hidden)",
        "hidden &= ~of(self._is_line)",
    ),
    mutant(
        "film boundary: silhouettes that lie in another surface count as lines, too",
        "edge_sampling/geometry/device_edges.py",
        "hidden_line |= self._repeats_silhouette(positions, edge, eye, view)",
        "pass",
    ),
    mutant(
        "film boundary: curves in which spheres cut other shapes follow one of both only",
        "edge_sampling/geometry/cut_curves.py",
        "surfaces = [s.distance(mi.Vector3d(p)) for s in pairs.surfaces(positions)]",
        "surfaces = [s.distance(mi.Vector3d(p)) for s in (pairs.surfaces(positions)[0], pairs.surfaces(still)[1])]",
    ),
    mutant(
        "film boundary: silhouettes that lie exactly behind others count",
        "edge_sampling/geometry/device_edges.py",
        "covered = (covers[0] | covers[1]) & ~(shown[0] | shown[1])",
        "covered = mi.Bool(False)",
    ),
    mutant(
        "film boundary: borders of a face that is seen edge-on count where something is before them",
        "edge_sampling/geometry/device_edges.py",
        "(edge_on[0] | edge_on[1]) & (before | ~reached)",
        "(edge_on[0] | edge_on[1]) & ~reached",
    ),
    mutant(
        "film boundary: borders of a face that is seen edge-on count where they are in the air",
        "edge_sampling/geometry/device_edges.py",
        "(edge_on[0] | edge_on[1]) & (before | ~reached)",
        "(edge_on[0] | edge_on[1]) & before",
    ),
    mutant(
        "film boundary: both halves of a rim that is seen edge-on count",
        "edge_sampling/boundaries/film_boundary.py",
        "seen &= through | ~nearer",
        "pass",
    ),
    mutant(
        "film boundary: rims of a wall that is seen edge-on count where they are in the air",
        "edge_sampling/boundaries/film_boundary.py",
        "(seen & (reached | ~edge_on[0] | ~edge_on[1]))",
        "seen",
    ),
    mutant(
        "shadows from lights: of a face along which light shines, only one border throws a shadow",
        "edge_sampling/boundaries/shadow_boundary.py",
        "outline.outward(across, ω, either=True)",
        "outline.outward(across, ω)",
    ),
    mutant(
        "mirrors and textures: which way goes on at a mask of plastic depends on its opacity",
        "plugins/transport/film_chains.py",
        "for s in surfaces(tracer.scene) if self._any_mask and is_shiny_mask(s)",
        "for s in ()",
    ),
    mutant(
        "lines of textures: looked at as closely as they are found",
        "plugins/terms/jumps.py",
        "texels = dr.maximum(BESIDE_TEXTURE *",
        "texels = dr.maximum(0 * BESIDE_TEXTURE *",
    ),
    mutant(
        "lines of textures: the border of a projector's picture stands still when its light turns",
        "edge_sampling/geometry/beams.py",
        "return emitter.sample_direction(si, mi.Point2f(0))[0].uv",
        "return dr.detach(emitter.sample_direction(si, mi.Point2f(0))[0].uv)",
    ),
    # ---------------------- Chains ----------------------
    mutant(
        "shadows in indirect light: 2 % too large",
        INDIRECT,
        "return jump * dr.dot(n_dl,",
        "return 1.02 * jump * dr.dot(n_dl,",
    ),
    mutant(
        "beams in indirect light: their lines stand still when the light turns",
        "edge_sampling/boundaries/indirect_beams.py",
        "        return self.lines.ray(light.light, self._on_picture(edge.sample)[0])",
        "        return dr.detach(self.lines.ray(light.light, self._on_picture(edge.sample)[0]))",
    ),
    mutant(
        "beams in indirect light: the other side of a line is dark",
        "edge_sampling/boundaries/indirect_beams.py",
        "for sign in (1, -1):",
        "for sign in (1,):",
    ),
    mutant(
        "chain: cut behind the second vertex",
        REPLAY,
        "ray.o, ray.d = dr.replace_grad(ray.o, o), dr.replace_grad(ray.d, d)",
        "ray.o, ray.d = dr.detach(ray.o), dr.detach(ray.d)",
    ),
    mutant(
        "vicinity: its weight has no derivative",
        PARAMETRISATION,
        "rest = 1 - division.held(dr.square(along), turned)",
        "rest = 1 - division.held(dr.square(dr.detach(along)), turned)",
    ),
    mutant(
        "vicinity: normals that face away stay so just inside of an outline",
        "plugins/transport/paths.py",
        "turn_to_viewer(si, vertex.ray, active & beside_outline & (vertex.depth == first))",
        "turn_to_viewer(si, vertex.ray, active & beside_outline & (vertex.depth < first))",
    ),
    mutant(
        "edges on surfaces: lines in which shapes cut through each other count on one side only",
        SILHOUETTES,
        "& ~self.slides & ~self.is_line",
        "& ~self.slides",
    ),
    mutant(
        "close lamps: shadows that are found from them move as if points of them were held",
        "edge_sampling/boundaries/near_lamps.py",
        "return slid * (",
        "return 0 * slid * (",
    ),
    mutant(
        "close lamps: their own outlines are no boundaries",
        SHADING,
        "L = self._radiance(tracer.scene, y, light, active & emission)",
        "L = mi.Spectrum(0)",
    ),
    mutant(
        "narrow lobes: shadows that are found from lamps are those of their whole light",
        SHADOWS,
        "Le *= 1 - division.turns(r2, ω_x)",
        "Le *= 1",
    ),
    mutant(
        "narrow lobes: boundaries do not turn with them",
        SHADING,
        "turned = dr.dot(n_dl, dr.select(active, division.turned(ω) - ω, 0))",
        "turned = 0",
    ),
    mutant(
        "narrow lobes: edges at points do not know how they turn, where light is scattered more than once",
        REPLAY,
        "dr.set_grad(leaf, dr.select(at_first, mi.Vector3f(δ), later))",
        "dr.set_grad(leaf, dr.select(at_first & (leaf is not self.leaves[3]), mi.Vector3f(δ), later))",
    ),
    mutant(
        "narrow lobes: edges at further vertices do not know how they turn",
        REPLAY,
        "return [p, n, d, axis]",
        "return [p, n, d, mi.Vector3f(zero)]",
    ),
    mutant(
        "vicinity: edges behind rough glass count on one side",
        SHADING,
        "to_surface = Division(point.vicinity.around(bsdf))",
        "to_surface = Division(point.vicinity)",
    ),
    mutant(
        "film boundary: light from one of two lunes",
        "edge_sampling/boundaries/lune.py",
        "dr.mulsign(dr.safe_sqrt(1 - dr.square(along)), side - 0.5)",
        "dr.safe_sqrt(1 - dr.square(along))",
    ),
    mutant(
        "edges from points: only what is seen past silhouettes counts",
        SHADING,
        "(faces * (edge - turned) - side",
        "(-side",
    ),
    mutant(
        "lines of textures: they do not follow texture coordinates",
        "edge_sampling/geometry/texture_edges.py",
        "[texcoords_of(inner(m)) if i",
        "[dr.detach(texcoords_of(inner(m))) if i",
    ),
    mutant(
        "lines of textures: only what is held in its direction counts", SHADING, "veiled | outline.crosses,", "veiled,"
    ),
    mutant(
        "edges from points: what is on the axis of a lamp's cone may be beside it",
        "edge_sampling/choice/importance.py",
        "off2 <= ON_AXIS * dr.squared_norm(d)",
        "off2 == 0",
    ),
    # ---------------------- Channels besides light ----------------------
    mutant(
        "channels: what a ray meets follows the surface",
        "plugins/transport/channels.py",
        "si = seen_by_camera(self.scene, ray, pi, active, attached=attached)",
        "si = pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.FollowShape, active)",
    ),
    mutant(
        "channels: edges of smooth meshes left out",
        "plugins/integrators/_channel_search.py",
        '"soft": "geo_normal" in self.kinds',
        '"soft": False',
    ),
    mutant(
        "channels: seams of texture coordinates left out",
        "plugins/integrators/_channel_search.py",
        'seams = bool(self.kinds & {"uv", "albedo"})',
        "seams = False",
    ),
    mutant(
        "textures: lines along the edges of mirrors counted twice",
        OUTLINES,
        "int(mi.BSDFFlags.Null | mi.BSDFFlags.DeltaReflection)",
        "int(mi.BSDFFlags.Null)",
    ),
    mutant(
        "textures: the seams of spheres beside mirrors lost",
        TEXTURE_LINES,
        "[shape for shape, _ in self._shapes if shape.is_mesh()]",
        "[shape for shape, _ in self._shapes]",
    ),
    mutant(
        "textures: what does not go on around spheres lost",
        TEXTURE_LINES,
        "light is None and jumps_at_seam(",
        "False and jumps_at_seam(",
    ),
    mutant(
        "textures: lines along the edges of milk glass counted twice",
        TEXTURE_LINES,
        "rough = bends_light(shape) and",
        "rough = False and",
    ),
    mutant(
        "textures: lines along the edges of facets counted twice",
        "edge_sampling/geometry/texture_edges.py",
        "crossed &= ~self._on_crease(positions)",
        "pass",
    ),
    mutant(
        "held points: jumps of what mirrors with maps show taken for outlines",
        SEARCH,
        "[s for s in at_rest if not is_mapped_mirror(s)]",
        "list(at_rest)",
    ),
    mutant(
        "film boundary: what veils before an edge mirror counts there",
        "edge_sampling/boundaries/film_boundary.py",
        "            if self.veils:\n                slack",
        "            if False:\n                slack",
    ),
    mutant(
        "film boundary: edges count where a veil before them ends as well",
        "edge_sampling/boundaries/film_boundary.py",
        "active &= passed[0] == passed[1]",
        "active &= True",
    ),
    mutant(
        "film boundary: lines of textures count below what stands on them",
        "edge_sampling/boundaries/film_boundary.py",
        "hidden |= (bent > 0) & ~one",
        "hidden |= mi.Bool(False)",
    ),
    mutant(
        "edges: things side by side keep edges of their own",
        "edge_sampling/geometry/cracks.py",
        "edges.open | _beside_others(geometry, edges, weld.surface)",
        "edges.open",
    ),
    mutant(
        "intersections: lines that run along the edges of a floor are lost",
        "edge_sampling/geometry/intersections.py",
        "goes_on |= here",
        "pass",
    ),
    mutant(
        "intersections: what only touches cuts",
        "edge_sampling/geometry/intersections.py",
        "            cut &= goes_through | self._goes_on(positions, face, plane, slack)[0]",
        "            pass",
    ),
    mutant(
        "intersections: edges do not rest",
        "edge_sampling/geometry/intersections.py",
        "dr.scatter(of_place, 1, dr.gather(mi.UInt32, self._place_of, end), goes_on & ~too)",
        "pass",
    ),
    mutant(
        "edges: a box on the edges of a floor moves with these",
        "edge_sampling/geometry/edges.py",
        "sides, count = np.where(alone, 1, sides), np.where(crossing, 2, count)",
        "side, count = half.side, np.where(crossing, 2, count)",
    ),
    mutant(
        "film boundary: edges at which many faces meet count where something hides them",
        "edge_sampling/geometry/device_edges.py",
        "hidden = dr.select(of(self._few_faces), hidden, ~reached)",
        "hidden &= of(self._few_faces)",
    ),
    mutant(
        "film boundary: what leans over its foot darkens what it stands on",
        "edge_sampling/boundaries/both_sides.py",
        "farther = touching & (clear > aside)",
        "farther = mi.Bool(False)",
    ),
    mutant(
        "edges from points: what leans over its foot darkens what it stands on",
        "edge_sampling/boundaries/past_edges.py",
        "farther, aside = clear > aside, dr.maximum(clear, aside)",
        "farther = mi.Bool(False)",
    ),
    mutant(
        "shadows in light from surfaces: where nothing sends light, other terms lose their points, too",
        "plugins/transport/bidirectional_tracer.py",
        "active = active & (vertex.number > 0) & self.depths.scatters(depth + vertex.number)",
        "active &= (vertex.number > 0) & self.depths.scatters(depth + vertex.number)",
    ),
    mutant(
        "shadows from lights: sides of boxes that stand flush throw shadows on each other",
        "edge_sampling/boundaries/fallen_shadow.py",
        "(at_foot | edge.outline.is_behind(hit.n, ω))",
        "edge.outline.is_behind(hit.n, ω)",
    ),
    mutant(
        "shadows from lights: all edges in one plane with the light count",
        "edge_sampling/boundaries/fallen_shadow.py",
        "active &= ~_in_front(scene, light, edge, aside, active)",
        "active &= mi.Bool(True)",
    ),
    mutant(
        "shadows from lights: those that end at an edge count",
        SHADOWS,
        "active &= on_both_sides(tracer, projection, sensor, view, shadow, n_dl, active)",
        "active &= mi.Bool(True)",
    ),
]


def copy_of_project(folder: Path) -> None:
    ignore = shutil.ignore_patterns("__pycache__", ".pytest_cache")
    for source, target in PACKAGES.items():
        shutil.copytree(ROOT / source, folder / "rimlight" / target, ignore=ignore, dirs_exist_ok=True)
    shutil.copytree(ROOT / "tests", folder / "tests", ignore=ignore)
    shutil.copy(ROOT / "pyproject.toml", folder)


def path(m: Mutant, folder: Path) -> Path:
    package, _, rest = m.file.partition("/")
    return folder / "rimlight" / PACKAGES[package] / rest


def changed(m: Mutant, text: str) -> str:
    """The text of its file with the fault.

    Raises
    ------
    ValueError : what is to be changed is not there, or more than once.
    """
    for old, new in m.changes:
        if text.count(old) != 1:
            raise ValueError(f"{m.fault}: {m.file} has {text.count(old)} times: {old}")
        text = text.replace(old, new)
    return text


def failures(m: Mutant, tests: list[str], stop_at: int = 3) -> list[str]:
    """Names of the first tests that fail with it: of the fast ones, or of those of `make test`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy_of_project(folder)
        file = path(m, folder)
        file.write_text(changed(m, file.read_text()))
        # Found before the project that is installed.
        environment = {**os.environ, "PYTHONPATH": str(folder)}
        for which in ("fast", "not slow"):
            options = ["-q", "-n", "2", "--maxfail", str(stop_at), "-p", "no:cacheprovider", "-m", which]
            command = [sys.executable, "-m", "pytest", *options, *tests]
            run = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
            if run.returncode not in (0, 1, 2, 5):  # 5: none of them is fast
                raise SystemExit(f"{m.fault}: the tests did not run\n{run.stdout[-2000:]}{run.stderr[-2000:]}")
            found = re.findall(r"^(?:FAILED|ERROR) (\S+)", run.stdout, re.M)
            if found:
                return found
    return []


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tests", nargs="*", default=[f"{FOLDER}/test_{name}.py" for name in TESTS], metavar="TEST")
    parser.add_argument("--only", type=int, nargs="*", metavar="NUMBER", help="these faults, counted from 0")
    parser.add_argument("--stop-at", type=int, default=3, metavar="COUNT", help="tests that have failed")
    parser.add_argument("--list", action="store_true", help="the faults")
    options = parser.parse_args()
    missed = []
    for k, m in enumerate(MUTANTS):
        if options.only is not None and k not in options.only:
            continue
        if options.list:
            print(f"{k:3d} {m.fault}")
            continue
        found = failures(m, options.tests, options.stop_at)
        caught = ", ".join(re.sub(r".*test_(\w+)\.py::", r"\1: ", name) for name in found)
        print(f"{k:3d} {m.fault:60s} {caught or 'NOT NOTICED'}", flush=True)
        missed += [] if found else [m.fault]
    if missed:
        print(f"Not noticed: {'; '.join(missed)}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
