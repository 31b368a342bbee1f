"""What derivatives lack, in words for the user."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight._plan import listed, names
from rimlight.edge_sampling import (
    Cracks,
    Geometry,
    jumping_textures,
    maps_in_steps,
    objects_below,
)
from rimlight.edge_sampling.geometry.beams import BEAMS, has_hard_beam
from rimlight.edge_sampling.geometry.grids import grids_of
from rimlight.edge_sampling.geometry.meshes import has_normal_map, inner, lets_rays_through, surfaces
from rimlight.edge_sampling.geometry.other_cuts import cuts_of_grids, cuts_of_others, cuts_of_tubes
from rimlight.edge_sampling.geometry.texture_edges import COARSE
from rimlight.edge_sampling.geometry.texture_lines import TEXTURE_UNIT_STEP, lattices
from rimlight.edge_sampling.geometry.tubes import steepest
from rimlight.edge_sampling.rays import extent
from rimlight.edge_sampling.refusals import Refusal
from rimlight.transport.paths import Depths

from ._coarse_limits import coarse_lamps, coarse_meshes
from ._overlaps import copies, fights

#: How much the radius of tubes may grow per length.
STEEP = 0.05

#: What perfect mirrors and glass do.
MIRRORS = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission

#: Parameters that Mitsuba 3.9 does not differentiate, or only in part, by the name of their class: from some, it makes
#: tables, or the probability with which it samples one lobe or another.
PARTIAL = {
    "RoughPlastic": ("alpha", "eta"),
    "SunskyEmitter": ("turbidity", "sun_direction"),
}


@dataclass(frozen=True)
class Moving:
    """What moves.

    known : the shapes that can, as `Geometry.known` has them. flags : do they? camera, lights : do these?
    mapped : shapes whose normal maps or bump maps change, or the index of whose glass, or their texture coordinates.
    sliding : those whose texture coordinates do.
    turning : does a mesh have vertex normals that change? Those that move do not count.
    """

    known: tuple[Any, ...]
    flags: tuple[bool, ...]
    camera: bool
    lights: bool
    mapped: tuple[Any, ...]
    sliding: tuple[Any, ...] = ()
    turning: tuple[bool, ...] = ()

    @property
    def key(self) -> tuple:
        return self.flags, self.turning, self.camera, self.lights, tuple(id(s) for s in (*self.mapped, *self.sliding))

    @property
    def anything(self) -> bool:
        return self.in_space or any(self.turning)

    @property
    def in_space(self) -> bool:
        """Does anything but the normals of meshes change that moves edges, as some point of a path sees them?"""
        return self.camera or self.lights or any(self.flags) or bool(self.mapped)

    @property
    def shapes(self) -> tuple[Any, ...]:
        """Those of the known shapes that move."""
        return tuple(s for s, moves in zip(self.known, self.flags, strict=True) if moves)

    @property
    def on_film(self) -> tuple[Any, ...]:
        """Those that move as seen from the camera."""
        return self.known if self.camera else self.shapes

    @property
    def with_lines(self) -> tuple[Any, ...]:
        """Those on which lines move as seen from the camera: of textures, and where mapped normals turn away."""
        return (*self.on_film, *(s for s in self.mapped if s not in self.on_film))


def lasting_limits(
    scene: mi.Scene,
    geometry: Geometry,
    cracks: Cracks,
    depths: Depths,
    moving: Moving,
    lined: Sequence[mi.Shape],
    sppi: int,
    *,
    planes: bool,
    from_points: bool,
) -> tuple[str, ...]:
    """What the derivative will lack as long as the edges stay what they are. lined : see `appearance`. planes,
    from_points : see `BoundarySearch`."""
    limits = []
    if sppi:
        limits += reflected_light(scene, geometry, depths, from_points=from_points)
        if depths.scatters(1):
            limits += coarse_lamps(scene, depths, planes=planes) + distant_scene(scene)
            limits += [] if planes else coarse_meshes(scene)
    return (
        *limits,
        *appearance(scene, depths, moving, lined, bisects=from_points),
        *outlines(scene, geometry, cracks, moving),
        *([*copies(scene), *fights(geometry)] if moving.in_space else ()),
    )


def reflected_light(scene: mi.Scene, geometry: Geometry, depths: Depths, *, from_points: bool) -> list[str]:
    """What lacks of the light that surfaces reflect."""
    limits = []
    if not from_points and (depths.scatters(2) or scene.environment() is not None):
        limits.append(
            "the derivative has the shadows that lights throw on what the camera sees, but lacks those of the "
            'environment and all that edges do to indirect light; set "sppi" to 0 to accept this.'
        )
    beams = names(e for e in scene.emitters() if has_hard_beam(e))
    if beams and not from_points:
        limits.append(
            f"the derivative lacks the border of the beams of {listed(beams)}: give a spot a beam_width below its "
            "cutoff_angle, and a projector an image with a black border."
        )
    if not from_points and any(is_mirror(s) for s in surfaces(scene)):
        limits.append(
            "the derivative lacks the motion of what perfect mirrors and glass show; give them a roughness, or set "
            '"sppi" to 0 to accept this.'
        )
    limits += veils(scene, from_points=from_points) if depths.scatters(2) else []
    casts = names(s for s in geometry.others if not s.is_emitter())
    if casts:
        limits.append(
            f"the derivative lacks the shadows and reflections of {listed(casts)} on what moves, or in moving "
            "light: their silhouettes are unknown. Replace them by meshes."
        )
    return limits


def veils(scene: mi.Scene, *, from_points: bool) -> list[str]:
    """What lacks of what is seen through surfaces that rays go through as if nothing was there."""
    through = [s for s in surfaces(scene) if lets_rays_through(s)]
    if not through or from_points:
        return []
    return [
        "the derivative lacks part of the motion of what is seen, and of what shines, through "
        f'{listed(names(through))}; cut the meshes out, or set "max_depth" to 2 or "sppi" to 0 to accept this.'
    ]


def appearance(
    scene: mi.Scene, depths: Depths, moving: Moving, lined: Sequence[mi.Shape], *, bisects: bool
) -> list[str]:
    """What lacks of the jumps inside of surfaces and environments. bisects : are the lines of textures found? lined :
    on which shapes points see them."""
    limits = []
    beams = [e for e in scene.emitters() if e.class_name() in BEAMS] if bisects else []
    textures = jumping_textures(scene, besides=(*surfaces(scene), *beams) if bisects else ())
    if textures:
        limits.append(
            f"the derivative lacks the jumps of the textures {listed(textures)}; use bilinear bitmaps, "
            "which repeat around spheres, and normal maps for bump maps."
        )
    mapped = names(s for s in moving.with_lines if has_normal_map(s))
    if mapped and not bisects:
        limits.append(
            f"the derivative is off by some per cent at the outlines of {listed(mapped)}: the normals of a normal "
            "map turn away from the sensor along lines inside of faces, whose jumps are not sampled."
        )
    elif mapped and depths.scatters(2):
        limits.append(
            f"the derivative lacks, in indirect light, the lines along which the normals of the maps of "
            f"{listed(mapped)} turn away from what they light."
        )
    unknown = [s for s in surfaces(scene) if moving.anything and s not in lined and lattices(s)]
    if unknown and bisects and depths.scatters(2):
        little = "" if any(s in moving.sliding for s in unknown) else ", which matter little if they are fine"
        limits.append(
            f"the derivative lacks, in the light that {listed(names(unknown))} throw on surfaces close to them, the "
            f"jumps of their textures{little}; use bilinear bitmaps that repeat, or meshes with texture coordinates "
            f"and at most {COARSE} lines across."
        )
    lamps = names(
        s for s in moving.sliding if s.is_emitter() and s.emitter().flags() & mi.EmitterFlags.SpatiallyVarying
    )
    if lamps:
        limits.append(
            f"Mitsuba goes on to look for the light of {listed(lamps)} by the texture coordinates that they had at "
            "first: load the scene anew after each step, or set the sampling_weight of these lamps to 0."
        )
    mirrors = [s for s in surfaces(scene) if is_mirror(s)] if depths.scatters(1) else []
    stepped = maps_in_steps([*moving.with_lines, *(mirrors if moving.anything else ())])
    if stepped:
        limits.append(
            "the derivative is off where the normals of maps turn away, and in what mirrors and glass with maps show, "
            f"since this GPU interpolates the bitmaps {listed(stepped)} in {round(1 / TEXTURE_UNIT_STEP)} steps; "
            'set their property "accel" to false.'
        )
    slides = moving.camera or moving.lights or (mirrors and moving.anything)
    if slides and any(e.class_name() == "SunskyEmitter" for e in scene.emitters()):
        limits.append(
            "the derivative lacks the motion of the border of the sun; set the sun_scale of sunsky to 0, and add a "
            "directional light."
        )
    discs = names(e for e in scene.emitters() if getattr(e, "shows_discs", False)) if slides else []
    if discs:
        limits.append(
            f"the derivative lacks the outlines of the discs of {listed(discs)}, where the camera sees them, or "
            "mirrors show them."
        )
    return limits


def outlines(scene: mi.Scene, geometry: Geometry, cracks: Cracks, moving: Moving) -> list[str]:
    """What lacks at the outlines of shapes."""
    limits = []
    grids = names(s for s in geometry.others if s.class_name() == "SDFGrid")
    if grids:
        limits.append(
            f"the derivative is off by up to a fifth at the silhouettes of {listed(grids)} (sdfgrid), which are not "
            "known: give the grid as many values along each axis as along the others."
        )
    hard = any(e.flags() & mi.EmitterFlags.Delta or hasattr(e, "light_count") for e in scene.emitters())
    shaded = names(g.inner for g in grids_of(geometry) if moving.anything and hard)
    if shaded:
        limits.append(
            f"the derivative is off by up to a tenth in parts of the shading of {listed(shaded)} (sdfgrid), in "
            "lights without a size, at the shadow that it throws on itself."
        )
    shiny = names(g.inner for g in grids_of(geometry) if g in moving.on_film and is_mirror(g.inner))
    if shiny:
        limits.append(
            f"the derivative is noisy, and off by up to a fifth, in what {listed(shiny)} (sdfgrid) show, perfect "
            "mirrors or glass that move. Give them a roughness, or replace them by meshes."
        )
    turned = names(s for s in moving.known if s not in geometry.tubes and not has_its_inverse(s))
    if turned:
        limits.append(
            f'the derivative is wrong for {listed(turned)}: the inverse of "to_world" is not the one that Mitsuba '
            "keeps. It takes the axis of `rotate` as it is: give it the length 1."
        )
    stretched = names(s for s in moving.known if is_stretched(s) and has_its_inverse(s))
    if stretched:
        limits.append(
            f"the derivative is wrong for {listed(stretched)}: Mitsuba shows balls, as if they were not stretched. "
            "Scale them equally along all axes, or replace them by meshes."
        )
    moves = lambda s: s in moving.on_film
    cut = sorted({tuple(sorted((a.id(), b.id()))) for a, b in cuts_of_others(scene, geometry) if moves(a) or moves(b)})
    if cut:
        pairs = listed(f'"{a}" and "{b}"' for a, b in cut)
        limits.append(
            "the derivative lacks the curves in which spheres, disks and cylinders cut through shapes that are neither "
            f"such nor meshes: {pairs}. Replace them by meshes."
        )
    limits += of_tubes(scene, geometry, moving)
    pairs = [f'"{a.id()}" and "{b.id()}"' for a, b in cuts_of_grids(scene, geometry)]
    if pairs:
        limits.append(
            f"the derivative lacks the curves in which grids of signed distances cut through other shapes: "
            f"{listed(pairs)}. Replace the grids by meshes, or move them apart."
        )
    closed = {
        tuple(geometry.meshes[i].id() for i in pair): width
        for pair, width in cracks.widest().items()
        if moving.camera or any(moving.flags[i] for i in pair)
    }
    if closed:
        pairs = listed(f'"{a}"' if a == b else f'"{a}" and "{b}"' for a, b in sorted(closed))
        limits.append(
            f"the derivative takes cracks between open edges for closed, which are up to {max(closed.values()):.1g} "
            f"units wide: {pairs}. Join the vertices there, or move them farther apart."
        )
    return limits


def of_tubes(scene: mi.Scene, geometry: Geometry, moving: Moving) -> list[str]:
    """What lacks at the outlines of tubes, as b-spline curves are."""
    limits = []
    moves = lambda s: s in moving.on_film or inner(s) in (inner(m) for m in moving.shapes)
    cut = sorted(f'"{a.id()}" and "{b.id()}"' for a, b in cuts_of_tubes(scene, geometry) if moves(a) or moves(b))
    if cut:
        limits.append(
            f"the derivative lacks the curves in which b-spline curves cut through other shapes: {listed(cut)}. "
            "Replace them by meshes, or move them apart."
        )
    steep = names(s for s in geometry.tubes if steepest(s) > STEEP) if moving.in_space else ()
    if steep:
        limits.append(
            f"the derivative lacks part of the outlines of {listed(steep)}, where they are seen from their thin "
            f"end, almost along them: rays miss them there. Let their radius grow by at most {STEEP:g} per length."
        )
    return limits


def is_stretched(shape: Any) -> bool:
    """Is it a sphere, scaled differently along different axes?"""
    if not isinstance(shape, mi.Shape) or shape.class_name() != "Sphere":
        return False
    matrix = np.array(mi.traverse(shape)["to_world"].matrix, float).reshape(4, 4)[:3, :3]
    return bool(np.linalg.cond(matrix) > 1 + SHEARED)


def has_its_inverse(shape: Any) -> bool:
    """Is the inverse that Mitsuba keeps of the transformation of a shape that of its matrix? (The vertices of a mesh
    are transformed already. The place of a shape is left out, which rounding moves far from the origin.)"""
    if not isinstance(shape, mi.Shape) or shape.is_mesh():
        return True
    to_world = mi.traverse(shape)["to_world"]
    linear, inverse = (np.array(m, float).reshape(4, 4)[:3, :3] for m in (to_world.matrix, to_world.inverse().matrix))
    return bool(np.abs(linear @ inverse - np.eye(3)).max() < SHEARED)


def is_mirror(shape: mi.Shape) -> bool:
    """Does the shape reflect or refract perfectly?"""
    return shape.bsdf() is not None and bool(shape.bsdf().flags() & MIRRORS)


class PartialParameters:
    """The parameters of a scene that Mitsuba differentiates in part only."""

    def __init__(self, scene: mi.Scene):
        self.found: list[tuple[str, Any, tuple[str, ...]]] = []
        for name, o in objects_below(scene).items():
            keys = PARTIAL.get(o.class_name(), ())
            if o.class_name() == "BlendBSDF" and o.flags() & MIRRORS:
                keys = ("weight.value", "weight.data")
            if keys:
                self.found.append((name, o, keys))

    def limits(self) -> list[str]:
        """What the derivative lacks with respect to those that carry a gradient now."""
        changing = []
        for name, o, keys in self.found:
            params = mi.traverse(o)
            changing += [f'"{name}.{k}" ({o.class_name()})' for k in keys if k in params and dr.grad_enabled(params[k])]
        return [
            f"the derivative lacks part of what {c} does, since Mitsuba does not differentiate it." for c in changing
        ]


class Media:
    """The participating media of a scene. Paths go through them as if they were empty."""

    def __init__(self, scene: mi.Scene):
        self.found = {name: o for name, o in objects_below(scene).items() if isinstance(o, mi.Medium)}

    def limits(self) -> list[str]:
        listed = ", ".join(f'"{name}" ({o.class_name()})' for name, o in self.found.items())
        lacking = (
            f"image and derivative take the participating media {listed} for empty; remove them, or use Mitsuba's "
            "prbvolpath, which differentiates media, but not the visibility of surfaces."
        )
        return [lacking] if listed else []

    def refuse_gradients(self, who: str) -> None:
        """Refuse derivatives with respect to parameters of media.

        Raises
        ------
        RuntimeError : one of them carries a gradient.
        """
        for name, medium in self.found.items():
            params = mi.traverse(medium)
            for key in [k for k in params.properties if dr.grad_enabled(params[k])]:
                raise Refusal(
                    f'{who}: "{name}.{key}" ({medium.class_name()}) carries a gradient, but participating media '
                    "are not supported. Detach it, or use Mitsuba's prbvolpath."
                )


def refuse_timed_sky(scene: mi.Scene, who: str) -> None:
    """Refuse a light that Mitsuba 3.9 cannot sample in symbolic loops, before these raise an error that names nothing.

    Raises
    ------
    RuntimeError : there is such a light.
    """
    timed = names(e for e in scene.emitters() if e.class_name() == "TimedSunskyEmitter")
    if timed and dr.flag(dr.JitFlag.SymbolicLoops):
        raise Refusal(
            f"{who}: Mitsuba cannot sample {listed(timed)} (timed_sunsky) in symbolic loops. Replace it by sunsky."
        )


def distant_scene(scene: mi.Scene) -> list[str]:
    """What the derivative lacks where a scene is so far from the origin that rounding shows."""
    size, reach = extent(scene)
    if not np.isfinite(size) or reach <= DISTANT * size:
        return []
    return [
        f"shadows and reflections are off by some per cent: the whole scene measures {size:.1g}, and lies {reach:.1g} "
        "units away from the origin, where single precision cannot tell its points apart. Bring it close to the origin."
    ]


#: How far a transformation times its inverse may be from the identity, and that of a sphere from equal scales.
SHEARED = 1e-3

#: Largest coordinate of a scene, relative to its diagonal, up to which there is no warning.
DISTANT = 1000
