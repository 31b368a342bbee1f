"""What the edges of a scene were derived from, and whether that is still so.

Edges are found on the host, which takes seconds for a million of them; an optimisation step takes milliseconds. So they
are kept as long as what they were derived from stays as it was: which shapes, materials and lights there are, their
faces, which vertices lie at the same place, and where attributes differ between those; which beams end with a jump,
which textures are even, or go on around a sphere, and where they have their texels. Vertices may move, as long as none
of them part, and none meet, and the vertex normals of flat faces stay theirs.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .beams import BEAMS, border_values, has_hard_beam
from .cracks import Cracks
from .edges import Edges, Weld
from .meshes import (
    Geometry,
    attribute_of,
    bent_faces,
    faces_of,
    has_interpolated_normals,
    has_place,
    has_texcoords,
    is_smooth,
    normals_of,
    objects_below,
    positions_of,
    surfaces,
    texcoords_of,
    vertex_attributes,
)
from .parameters import Parameter
from .texture_lines import is_even, numbers_of_place, texture_values
from .texture_seams import SEAM_OF, jumps_at_seam

#: Vertices that were at the same place are apart if they differ by more than so many times the rounding error.
APART = 64

#: And if they differed then, by more than so many times that, and what was tolerated: those that would be welded again
#: are not to be found apart.
HYSTERESIS = 4


class Sources:
    """What was there when the edges were found.

    It holds all that it compares with, so that neither the address of an object nor the number of an array is given to
    another one. (It does not hold the scene, which may own the integrator that holds this.)

    Parameters
    ----------
    scene, found : the scene and its parameters.
    geometry : its shapes.
    edges, weld, cracks : of the meshes.
    """

    def __init__(
        self,
        scene: mi.Scene,
        found: list[Parameter],
        geometry: Geometry,
        edges: Edges,
        weld: Weld,
        cracks: Cracks,
    ) -> None:
        self._objects, self._numbers = _objects(scene, found, geometry)
        #: Mesh → its pairs of vertices at the two sides of edges.
        self._seams = _seams(geometry, edges)
        self._attributes = {i: tuple(vertex_attributes(geometry.meshes[i])) for i in self._seams}
        #: Meshes with interpolated normals that are those of the faces: `FacePlanes` and `Horizons` leave them out.
        self._flat = [i for i, m in enumerate(geometry.meshes) if has_interpolated_normals(m) and not is_smooth(m)]
        self._held = self._arrays(geometry)
        self._differing = {
            (i, name): self._differ(i, array)
            for (i, name), array in self._held.items()
            if i in self._seams and name not in ("faces", "positions", "normals")
        }
        dr.eval(self._differing)
        #: Lights and textures: by which arrays, and by which question, it is told whether something jumps.
        self._pictures = {e: (border_values, has_hard_beam) for e in scene.emitters() if e.class_name() in BEAMS}
        # (Two shapes may share a texture, and have their seams along different axes.)
        of = {(o, s.class_name()) for s in surfaces(scene) for o in objects_below(s).values() if has_place(o)}
        whole = {o for o, name in of if name in SEAM_OF and not jumps_at_seam(o, name)}
        seams = lambda o: [name for p, name in of if p is o and jumps_at_seam(o, name)]
        self._pictures |= dict.fromkeys(whole, (texture_values, seams))
        even = [o for o in objects_below(scene).values() if has_place(o) and is_even(o)]
        self._pictures |= dict.fromkeys(even, (texture_values, is_even))
        self._answers = {o: (values(o), answer(o)) for o, (values, answer) in self._pictures.items()}
        #: Vertices at different places, and pairs at the same place.
        first, place = weld.first, weld.place
        self._first = _index(first)
        self._pairs: tuple[mi.UInt32, mi.UInt32] | None = None
        if len(first) < len(place):
            others = np.setdiff1d(np.arange(len(place)), first)
            self._pairs = _index(others), _index(first[place[others]])
            p = geometry.host_positions()
            distance = np.linalg.norm(p[others] - p[first[place[others]]], axis=1)
            tolerance = np.where(distance > 0, HYSTERESIS * np.maximum(distance, weld.tolerance), 0)
            #: How far apart each pair may be, whatever the rounding error: scene units.
            self._tolerance = mi.Float(tolerance.astype(np.float32))

        #: Vertices that lie on edges: these, the end points, where between them, and how far apart.
        self._on_edges: tuple | None = None
        if len(cracks):
            ends = [_index(cracks.ends[:, k]) for k in (0, 1)]
            at, tolerance = (mi.Float(x.astype(np.float32)) for x in (cracks.at, HYSTERESIS * cracks.tolerance))
            self._on_edges = _index(cracks.vertex), ends, at, tolerance

    def same_objects(self, scene: mi.Scene, found: list[Parameter], geometry: Geometry) -> bool:
        """Are there the same shapes, of the same size, with the same materials and lights? Asks the host alone."""
        objects, numbers = _objects(scene, found, geometry)
        same = len(objects) == len(self._objects)
        same = same and all(a is b for a, b in zip(objects, self._objects, strict=True))
        return same and numbers == self._numbers

    def same_content(self, geometry: Geometry) -> bool:
        """Are the faces the same, and which vertices lie at the same place, and where attributes differ between those;
        and are those meshes flat-shaded that were?

        Reads one bit from the device, or nothing if no array was replaced. (Where one was, Mitsuba has just waited for
        the device, to find the bounding box.) Not in frozen functions.
        """
        if not self._same_pictures():
            return False
        new = self._arrays(geometry)
        replaced = [key for key, array in new.items() if array.index != self._held[key].index]
        if not replaced:
            return True
        changes = []
        for i, name in replaced:
            if name == "faces":
                changes.append(new[i, name] != self._held[i, name])
            elif name not in ("positions", "normals"):
                changes.append(self._differ(i, new[i, name]) != self._differing[i, name])
        changes += [bent_faces(geometry.meshes[i]) for i, name in replaced if name == "normals"]
        if any(name == "positions" for _, name in replaced):
            changes += self._parted_or_met(dr.detach(geometry.positions()))
        changed = mi.Bool(False)
        for change in changes:
            changed |= dr.any(change)
        if changed[0]:
            return False
        self._held = new
        return True

    def _same_pictures(self) -> bool:
        """Do those beams end with a jump that did so, and are textures even that were, and without a seam? Looks at
        what was replaced."""
        for o, (held, before) in self._answers.items():
            values, answer = self._pictures[o]
            new = values(o)
            if any(v.index != h.index for v, h in zip(new, held, strict=True)):
                if answer(o) != before:
                    return False
                self._answers[o] = new, before
        return True

    def _arrays(self, geometry: Geometry) -> dict[tuple[int, str], Any]:
        """All arrays that matter, by mesh and name; detached."""
        arrays = {}
        for i, mesh in enumerate(geometry.meshes):
            arrays[i, "faces"] = faces_of(mesh)
            arrays[i, "positions"] = dr.detach(positions_of(mesh))
            if i in self._flat:
                arrays[i, "normals"] = dr.detach(normals_of(mesh))
            if i in self._seams:
                if has_texcoords(mesh):
                    arrays[i, "texcoords"] = dr.detach(texcoords_of(mesh))
                for name in self._attributes[i]:
                    arrays[i, name] = dr.detach(attribute_of(mesh, name))
        return arrays

    def _differ(self, mesh: int, values: mi.Float) -> mi.Bool:
        """At which pairs of vertices of a mesh do these values, (K V,), differ?"""
        a, b, count = self._seams[mesh]
        K = dr.width(values) // count
        differ = mi.Bool(False)
        for k in range(K):
            differ |= dr.gather(mi.Float, values, K * a + k) != dr.gather(mi.Float, values, K * b + k)
        return differ

    def _parted_or_met(self, positions: mi.Float) -> list[mi.Bool]:
        """Which vertices have left the place they had in common, or on an edge, and which have come to the place of
        others?"""
        changes = []
        if self._pairs is not None:
            p, q = (dr.gather(mi.Point3f, positions, i) for i in self._pairs)
            changes.append(_are_apart(p, q, self._tolerance))
        if self._on_edges is not None:
            vertex, ends, at, tolerance = self._on_edges
            a, b = (dr.gather(mi.Point3f, positions, i) for i in ends)
            changes.append(_are_apart(dr.gather(mi.Point3f, positions, vertex), dr.lerp(a, b, at), tolerance))
        changes.append(_coincide(positions, self._first))
        return changes


def _are_apart(p: mi.Point3f, q: mi.Point3f, tolerance: mi.Float) -> mi.Bool:
    rounding = dr.epsilon(mi.Float) * dr.max(dr.maximum(dr.abs(p), dr.abs(q)))
    return dr.norm(p - q) > dr.maximum(APART * rounding, tolerance)


def _coincide(positions: mi.Float, vertices: mi.UInt32) -> mi.Bool:
    """Which of `vertices` are exactly where another is? A few are not found, since this goes by a hash."""
    p = dr.gather(mi.Point3f, positions, vertices)
    bits = [dr.reinterpret_array(mi.UInt32, dr.select(x == 0, 0, x)) for x in p]
    hashed = bits[0] * 0x9E3779B1 ^ bits[1] * 0x85EBCA77 ^ bits[2] * 0xC2B2AE3D
    hashed ^= hashed >> 15
    hashed *= 0x2C1B3C6D
    hashed ^= hashed >> 13
    count = dr.width(vertices)
    slot = hashed & ((1 << (4 * count).bit_length()) - 1)
    table = dr.zeros(mi.UInt32, 1 << (4 * count).bit_length())
    i = dr.arange(mi.UInt32, count)
    dr.scatter(table, i, slot)
    other = dr.gather(mi.UInt32, table, slot)
    q = dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, vertices, other))
    return (other != i) & dr.all(p == q)


def _objects(scene: mi.Scene, found: list[Parameter], geometry: Geometry) -> tuple[list[Any], list[Any]]:
    """All shapes, materials, textures, lights and media; and the numbers that tell what they are, and where textures
    may jump."""
    shapes, emitters = scene.shapes(), scene.emitters()
    bsdfs = [s.bsdf() for s in shapes]
    kinds = (mi.Shape, mi.BSDF, mi.Emitter, mi.Texture, mi.Medium)
    nodes = [p.node for p in found if isinstance(p.node, kinds)]
    numbers = [(m.vertex_count(), m.face_count(), has_interpolated_normals(m)) for m in geometry.meshes]
    numbers += [b.flags() for b in bsdfs if b is not None]
    numbers += [(e.flags(), getattr(e, "light_count", 1)) for e in emitters]
    numbers += [numbers_of_place(p.name, p.value) for p in found if isinstance(p.node, mi.Texture)]
    return [*shapes, *emitters, *bsdfs, *nodes], [*numbers, *(p.name for p in found)]


def _seams(geometry: Geometry, edges: Edges) -> dict[int, tuple[mi.UInt32, mi.UInt32, int]]:
    """For each mesh with split vertices: the pairs of them at the two sides of an edge, and its number of vertices."""
    offsets = np.cumsum([0, *(m.vertex_count() for m in geometry.meshes)])
    pairs = edges.vertices.transpose(0, 2, 1).reshape(-1, 2)
    mesh, inside = np.repeat(edges.mesh[:, 0], 2), np.repeat(edges.mesh[:, 0] == edges.mesh[:, 1], 2)
    split = inside & (pairs[:, 0] != pairs[:, 1]) & np.repeat(~edges.joined, 2)
    seams = {}
    for i in np.unique(mesh[split]).tolist():
        a, b = np.unique(pairs[split & (mesh == i)], axis=0).T - offsets[i]
        seams[i] = _index(a), _index(b), geometry.meshes[i].vertex_count()
    return seams


def _index(numbers: np.ndarray) -> mi.UInt32:
    return mi.UInt32(np.ascontiguousarray(numbers, dtype=np.uint32))
