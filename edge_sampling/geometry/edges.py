"""The edges of a scene: found on the meshes welded by position, and classified by what jumps across them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from rimlight.edge_sampling.refusals import InputError

from . import meshes
from .grids import is_grid
from .half_edges import HalfEdges, mix
from .meshes import Geometry
from .texture_lines import jumps_at_every_edge


class EdgeKind(IntEnum):
    """What makes an edge a boundary of the image.

    JUMP   : always: it has one face only, or more than two, or its two sides differ in shape, texture coordinates,
             attributes, or the frame of tangents that a material looks at, or one of them shows its back.
    FLAT   : as a silhouette, and where its faces are not coplanar: the shading normal is that of the face.
    SPLIT  : as a silhouette, and where the vertex normals of its two sides differ.
    SMOOTH : as a silhouette only.
    """

    JUMP = 0
    FLAT = 1
    SPLIT = 2
    SMOOTH = 3


#: Height of a triangle, relative to its longest side, up to which it has no area.
SLIVER = 1e-6

#: The part of a side that an edge has: all of it.
WHOLE = np.array([0, 1], np.float32)


@dataclass(frozen=True)
class Edges:
    """Topology of the edges of all meshes of a scene, on the host. Positions change, and are not stored.

    Vertex indices refer to `Geometry.positions`, that is, to the original vertices, not to welded ones. An edge has
    two sides. Where exporters have split the vertices, these name different vertices at the same place; a side that is
    missing (an open edge) repeats the other.

    vertices : (E, 2, 2), uint32; `[e, side]` = the two end points.
    opposite : (E, 2), uint32; the third vertex of the face on each side.
    mesh     : (E, 2), uint32; index into `Geometry.meshes` of the face on each side.
    kind     : (E,), uint8; an `EdgeKind`.
    count    : (E,), uint32; number of faces.
    is_line  : (E,), bool; is it a line in which shapes cut through each other (`Intersections`, `CutCurves`)? Its
               vertices are not those of a mesh, its mesh is not told, and its faces do not end there.
    part     : (E, 2, 2), float32; `[e, side]` = from where to where between these two end points the edge extends:
               0 and 1, unless the side was divided.
    joined   : (E,), bool; is it made of sides that lie on one another, or of a part of one (`close_cracks`)?

    The end points of the first side are in the order in which its face runs through them.
    """

    vertices: np.ndarray
    opposite: np.ndarray
    mesh: np.ndarray
    kind: np.ndarray
    count: np.ndarray
    is_line: np.ndarray
    part: np.ndarray
    joined: np.ndarray

    @property
    def open(self) -> np.ndarray:
        """Has the edge only one face? (E,), bool."""
        return self.count == 1

    def __len__(self) -> int:
        return len(self.kind)

    def take(self, which: np.ndarray) -> Edges:
        """Some of the edges, by index or by mask."""
        return Edges(*(getattr(self, f.name)[which] for f in fields(self)))

    def __add__(self, other: Edges) -> Edges:
        return Edges(*(np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)))

    def of_meshes(self, wanted: np.ndarray, *, lines: bool = False) -> Edges:
        """The edges that have a face in one of the meshes for which `wanted` (bool) holds. lines : and all lines?"""
        return self.take(np.where(self.is_line, lines, wanted[self.mesh].any(axis=1)))

    def of_textures(self, geometry: Geometry) -> np.ndarray:
        """The number of the piece of a line of a texture that each edge is, plus 1, or 0: (E,), uint32."""
        vertex, first = self.vertices[:, 0, 0].astype(np.int64), geometry.first_of_textures
        return np.where(vertex >= first, vertex - first + 1, 0).astype(np.uint32)

    def summary(self) -> dict[str, int]:
        counts = np.bincount(self.kind, minlength=len(EdgeKind))
        return {"edges": len(self), "open": int(self.open.sum()), **{k.name.lower(): int(counts[k]) for k in EdgeKind}}


@dataclass(frozen=True)
class Weld:
    """Which vertices were at the same place when the edges were found, on the host.

    place : (V,), int64; number of the place of each vertex of `Geometry.positions`.
    tolerance : how far apart vertices at one place may be, scene units.
    slivers : (S, 3), int64; the corners of the faces without area that were left out, the first of them between the
        others.
    surface : (E,), int64; number of the connected surface to which the first face of each edge belongs. Faces are
        connected at edges that have two.
    """

    place: np.ndarray
    tolerance: float
    slivers: np.ndarray
    surface: np.ndarray

    @property
    def first(self) -> np.ndarray:
        """The first vertex at each place: (P,), int64."""
        return np.unique(self.place, return_index=True)[1]


def find_edges(geometry: Geometry) -> Edges:
    """Find and classify the edges of all meshes, as one welded whole: `find_welded_edges`, the edges alone."""
    return find_welded_edges(geometry)[0]


def find_welded_edges(geometry: Geometry) -> tuple[Edges, Weld]:
    """Find and classify the edges of all meshes, as one welded whole.

    Welding over the borders of meshes makes one edge of two that coincide, as where the walls of a room meet: sampled
    as two, its jump would count twice. Triangles that are degenerate after welding, and repeated triangles, are
    ignored, and so are those without area that lie along an open border, which would end twice there.

    Raises
    ------
    ValueError : a vertex is not finite.
    """
    face_list, mesh_of_face, values = [], [], []
    points, offset = [], 0
    for i, mesh in enumerate(geometry.meshes):
        f, v = meshes.faces(mesh), meshes.vertices(mesh)
        if not np.isfinite(v).all():
            raise InputError(f'shape "{mesh.id()}": {int((~np.isfinite(v)).any(1).sum())} vertices are not finite')
        face_list.append(f.astype(np.int64) + offset)
        mesh_of_face.append(np.full(len(f), i, np.uint32))
        points.append(v)
        values.append(meshes.vertex_values(mesh))
        offset += len(v)
    if not points:
        none = np.zeros(0, np.int64)
        return _no_edges(), Weld(none, 0.0, np.zeros((0, 3), np.int64), none)
    face, mesh_of_face = np.concatenate(face_list), np.concatenate(mesh_of_face)
    point = np.concatenate(points)
    width = max(t.shape[1] for t in values)
    value = np.concatenate([np.pad(t, ((0, 0), (0, width - t.shape[1]))) for t in values])

    weld = _weld_equal(point)
    sides = _pair_sides(weld, face)
    # Coordinates that went through different transformations differ in their last bits; open edges alone can show it.
    rewelded, tolerance = _weld_close(point, weld, face, sides)
    if rewelded is not weld:
        weld, sides = rewelded, _pair_sides(rewelded, face)
    face, sides, slivers = _without_open_slivers(point, weld, face, sides)
    if (sides[-1] > 2).any():
        sides = _pair_sides(weld, face, point)

    face0, corner0, face1, corner1, count = sides
    i0, j0, o0 = _corners(face, face0, corner0)
    i1, j1, o1 = _corners(face, face1, corner1)
    turn = weld[i0] != weld[i1]
    i1, j1 = np.where(turn, j1, i1), np.where(turn, i1, j1)
    # Faces that run through their edge in the same direction look to different sides: one of them shows its back.
    opposed = ~turn & (count == 2)
    mesh0, mesh1 = mesh_of_face[face0], mesh_of_face[face1]

    interpolated = np.array([meshes.has_interpolated_normals(m) for m in geometry.meshes])
    everywhere = np.array([not is_grid(m) and jumps_at_every_edge(m) for m in geometry.meshes])
    split = (i0 != i1) | (j0 != j1)
    seam = split & ((value[i0] != value[i1]).any(1) | (value[j0] != value[j1]).any(1))

    kind = np.full(len(face0), EdgeKind.SMOOTH, np.uint8)
    kind[split] = EdgeKind.SPLIT
    kind[~interpolated[mesh0]] = EdgeKind.FLAT
    kind[_inside_of_voxels(geometry, np.stack([i0, j0], 1), mesh0)] = EdgeKind.SMOOTH
    kind[(count != 2) | opposed | (mesh0 != mesh1) | seam | everywhere[mesh0]] = EdgeKind.JUMP
    edges = Edges(
        vertices=np.stack([np.stack([i0, j0], 1), np.stack([i1, j1], 1)], 1).astype(np.uint32),
        opposite=np.stack([o0, o1], 1).astype(np.uint32),
        mesh=np.stack([mesh0, mesh1], 1),
        kind=kind,
        count=count.astype(np.uint32),
        is_line=np.zeros(len(face0), bool),
        part=np.broadcast_to(WHOLE, (len(face0), 2, 2)),
        joined=np.zeros(len(face0), bool),
    )
    joined = coo_array((np.ones(len(face0), bool), (face0, np.where(count == 2, face1, face0))), shape=(len(face),) * 2)
    surface = connected_components(joined, directed=False)[1][face0].astype(np.int64)
    return edges, Weld(weld, tolerance, slivers, surface)


def _inside_of_voxels(geometry: Geometry, ends: np.ndarray, mesh: np.ndarray) -> np.ndarray:
    """Which edges are inside of the voxels of a grid, where its surface is smooth: (E,), bool."""
    inside, offset = np.zeros(len(ends), bool), 0
    for i, m in enumerate(geometry.meshes):
        if is_grid(m):
            inside |= (mesh == i) & (ends >= offset + m.on_faces).any(1)
        offset += m.vertex_count()
    return inside


def _no_edges() -> Edges:
    none = np.zeros((0, 2), np.uint32)
    flat = lambda kind: np.zeros(0, kind)
    part = np.zeros((0, 2, 2), np.float32)
    return Edges(part.astype(np.uint32), none, none, flat(np.uint8), flat(np.uint32), flat(bool), part, flat(bool))


def _weld_equal(point: np.ndarray) -> np.ndarray:
    """Number the distinct positions: (V,), int64. Adding zero makes +0 and -0 the same bits."""
    return distinct_rows((point + np.float32(0)).view(np.uint32))[1]


def distinct_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number the distinct rows of a few integers, in any order.

    Returns of each number the first row that has it, (D,), and of each row its number, (N,), int64.
    """
    # To sort one integer a row is several times faster than to sort rows: mix them, and check for collisions.
    _, first, number = np.unique(mix(rows), return_index=True, return_inverse=True)
    if not (rows[first[number]] == rows).all():
        _, first, number = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return first, number.reshape(-1).astype(np.int64)


def _weld_close(
    point: np.ndarray, weld: np.ndarray, face: np.ndarray, sides: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, float]:
    """Join the welded vertices of open edges that are closer than single precision can tell apart. Also how close."""
    face0, corner0, _, _, count = sides
    lone = count == 1
    ends = np.concatenate([face[face0[lone], corner0[lone]], face[face0[lone], (corner0[lone] + 1) % 3]])
    if len(ends) == 0:
        return weld, 0.0
    _, representative = np.unique(weld[ends], return_index=True)
    vertex = ends[representative]
    tolerance = 8 * np.finfo(np.float32).eps * max(np.abs(point[vertex]).max(), np.finfo(np.float32).tiny)
    pairs = cKDTree(point[vertex]).query_pairs(tolerance, output_type="ndarray")
    if len(pairs) == 0:
        return weld, 0.0
    a, b = weld[vertex[pairs[:, 0]]], weld[vertex[pairs[:, 1]]]
    n = int(weld.max()) + 1
    _, group = connected_components(coo_array((np.ones(len(a), bool), (a, b)), shape=(n, n)), directed=False)
    return group[weld].astype(np.int64), float(tolerance)


def _pair_sides(weld: np.ndarray, face: np.ndarray, point: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
    """For every welded edge: face and corner of its first and second side, and the number of its faces.

    Corner k of a face stands for the side from its vertex k to vertex k + 1.

    point : of the vertices. If it is given, and of more than two faces at an edge all but one go on in the plane of
        another, two of them as parts of one surface, the edge is that of the one, as of a box that stands on the edges
        of a floor; the side that is missing repeats the other. Where two surfaces cross, both of which go on, the edge
        is that of one of them: the line of both is found apart.
    """
    half = HalfEdges.of(weld, face)
    side, first, count = half.side, half.first, half.count
    sides = np.minimum(count, 2)
    if point is not None:
        # Faces in one place are two here: a bottom that lies on a floor as one of its triangles.
        every = HalfEdges.of(weld, face, repeated=True)
        beyond = every.beyond(face, point)
        ends = np.sort(np.stack([face, np.roll(face, -1, axis=1)], 2).reshape(-1, 2), axis=1)
        goes_on = beyond >= 0
        # Where a surface has one vertex at each end, nothing jumps on it.
        alike = goes_on & (ends == ends[beyond]).all(1)
        of_all = lambda f, sides: f.reduceat(sides[every.side], every.first)
        alone = (of_all(np.add, ~goes_on) == 1) & of_all(np.logical_or, alike) & (count > 2)
        crossing = of_all(np.logical_and, alike) & (count == 4)
        edge = np.repeat(np.arange(len(first)), count)
        partner = np.where(crossing[edge], np.minimum(side, beyond[side]), 0)
        side = side[np.lexsort((partner, goes_on[side] & alone[edge], edge))]
        sides, count = np.where(alone, 1, sides), np.where(crossing, 2, count)
    h0, h1 = side[first], side[first + sides - 1]
    return h0 // 3, h0 % 3, h1 // 3, h1 % 3, count


def _without_open_slivers(
    point: np.ndarray, weld: np.ndarray, face: np.ndarray, sides: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, tuple[np.ndarray, ...], np.ndarray]:
    """Leave out the faces without area at open edges, one after the other.

    Returns the faces, of which these have one corner alone; the sides of the rest; and see `Weld.slivers`.
    """
    none = np.zeros((0, 3), np.int64)
    if not (sides[-1] == 1).any():
        return face, sides, none
    p = point[face].astype(np.float64)
    along = np.roll(p, -1, 1) - p
    squared = np.square(along).sum(2)
    thin = np.linalg.norm(np.cross(along[:, 0], along[:, 1]), axis=1) <= SLIVER * squared.max(1)
    rest, slivers = face.copy(), [none]
    while True:
        first, count = sides[0], sides[-1]
        found = np.unique(first[(count == 1) & thin[first]])
        if not len(found):
            return rest, sides, np.concatenate(slivers)
        between = (squared[found].argmax(1) + 2) % 3  # opposite to the longest side
        slivers.append(np.take_along_axis(face[found], (between[:, None] + np.arange(3)) % 3, 1))
        rest[found] = rest[found, :1]
        sides = _pair_sides(weld, rest)


def _corners(face: np.ndarray, f: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices of side k of faces f, and the vertex opposite to it."""
    return face[f, k], face[f, (k + 1) % 3], face[f, (k + 2) % 3]
