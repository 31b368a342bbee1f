"""All that can be an outline on the film: where it is, and how long it seems."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.geometry.common_line import cut_by_plane
from rimlight.edge_sampling.geometry.curve_point import CurvePoint
from rimlight.edge_sampling.geometry.curves import Curves
from rimlight.edge_sampling.geometry.device_edges import DeviceEdges
from rimlight.edge_sampling.geometry.edges import EdgeKind, Edges
from rimlight.edge_sampling.geometry.grids import grids_of, is_grid, normals
from rimlight.edge_sampling.geometry.meshes import Geometry
from rimlight.edge_sampling.projection.sensors import FilmPoint, Projection

from .crease import is_matt
from .horizon import HorizonPoint, Horizons
from .lune import Lune, spreads
from .near_cuts import NearCuts

#: Lengths on the film are added up as whole numbers of this many pixels: integer sums do not depend on their order, so
#: an edge that cannot be seen changes nothing, not even the last bit.
LENGTH_UNIT = 2.0**-16

#: Creases of matt surfaces are chosen by their length times the sine of their angle, but at least times this.
LEAST = 0.05

#: And only where there are so many.
FINE = 100

#: Lobes of which the jumps are found by bisection.
FOUND_ELSEWHERE = int(mi.BSDFFlags.Null | mi.BSDFFlags.DeltaReflection)


@dataclass
class Placed:
    """Where the outlines are, and how the sensor sees them; attached. aperture_sample : a point of the lens."""

    projection: Projection
    positions: mi.Float
    frames: mi.Float | None
    normals: mi.Float | None
    aperture_sample: mi.Point2f | None = None


@dataclass
class Chosen:
    """An edge, a cut through a face, a horizon, a piece of a curve or of a cut through an analytic shape, for each
    sample.

    index : mi.UInt32, (N,), among all of these.
    along : mi.Float, position along its visible part, uniform in [0, 1) on the film.
    density : mi.Float, expected number of samples on it; 0 where none is visible.
    edge, face, piece, cut : its number among those of its kind; 0 where it is of another.
    """

    index: mi.UInt32
    along: mi.Float
    density: mi.Float
    is_edge: mi.Bool
    is_line: mi.Bool
    is_horizon: mi.Bool
    is_curve: mi.Bool
    is_cut: mi.Bool
    edge: mi.UInt32
    face: mi.UInt32
    piece: mi.UInt32
    cut: mi.UInt32


@dataclass
class Found:
    """What is known of the points. Detached.

    along_film : mi.Vector2f, tangent on the film, by the fraction that was sampled: pixels. valid : is there one?
    t : parameter on an edge or a cut. eye : from where curves are seen. curve : the points on these.
    facing : mi.Vector2f, on the film, towards where normals face the viewer; of grids, away from their surface.
    forward : see `HorizonPoint`. normal : of the surface of a grid.
    """

    along_film: mi.Vector2f
    valid: mi.Bool
    t: mi.Float | None = None
    eye: mi.Point3f | None = None
    curve: CurvePoint | None = None
    facing: mi.Vector2f | None = None
    forward: mi.Float | float = 1.0
    normal: mi.Vector3f | None = None


class FilmOutlines:
    """The edges of meshes, the cuts of the near clipping plane through their faces, the horizons of interpolated
    normals, the curves of other shapes (see `Curves`), and the cuts through analytic ones.

    Parameters
    ----------
    geometry, edges, moving, turning, soft, seams, channels : see `FilmBoundary`.
    """

    _PARTS = ("edges", "corners", "spreads", "dark", "matt", "horizons", "curves", "near_cuts", "lines", "grids")
    DRJIT_STRUCT = dict.fromkeys((*_PARTS, "counts", "soft", "textures", "pieces"))  # for `dr.freeze`

    def __init__(
        self,
        geometry: Geometry,
        edges: Edges,
        moving: np.ndarray,
        turning: np.ndarray | bool,
        *,
        soft: bool,
        seams: bool,
        channels: bool,
    ):
        self.geometry, self.soft = geometry, soft
        self.lines, self.grids, self.textures = geometry.lines, grids_of(geometry), geometry.textures
        edges, faces = edges.of_meshes(moving, lines=geometry.any_line(moving)), geometry.faces(moving)
        # (Dr.Jit 1.5 cannot freeze empty arrays: if curves alone move, one face without area stands for all.)
        faces = faces if len(faces) else np.zeros((1, 3), np.uint32)
        self.edges = DeviceEdges(edges, geometry) if len(edges) else None
        #: Of each edge, the number of the piece of a line of a texture that it is, plus 1; 0: it is none.
        self.pieces = mi.UInt32(edges.of_textures(geometry)) if self.textures is not None else None
        self.corners = [mi.UInt32(np.ascontiguousarray(faces[:, k])) for k in range(3)] if len(edges) else []
        #: Which edges are on meshes that reflect light from all directions, but from behind? And on which is that all,
        #: besides what perfect mirrors and glass show, of which the jumps are looked for?
        known = [m.bsdf() if not is_grid(m) else None for m in geometry.meshes]
        of_mesh = edges.mesh[:, 0]
        spread = np.array([bsdf is not None and spreads(bsdf, FOUND_ELSEWHERE) for bsdf in known] or [False])
        is_dark = lambda bsdf: bsdf is not None and not channels and not bsdf.flags() & mi.BSDFFlags.Smooth
        dark = np.array([is_dark(bsdf) for bsdf in known] or [False])
        self.spreads, self.dark = (mi.Bool(of[of_mesh]) if len(edges) else None for of in (spread, dark))
        #: And which on meshes that are matt, without lines? None where these have few creases, and there is little to
        #: gain.
        matt = np.array([bsdf is not None and is_matt(bsdf) for bsdf in known] or [False])
        matt = matt[edges.mesh].all(1)
        if self.textures is not None:
            # What jumps at creases along which there is a line is more than their angle tells.
            matt &= ~np.isin(edges.mesh, list(self.textures.along_edges)).any(1)
        creases = matt & np.isin(edges.kind, (EdgeKind.FLAT, EdgeKind.SPLIT))
        self.matt = mi.Bool(matt) if creases.sum() >= FINE else None
        self.curves = Curves.of(geometry, moving[len(geometry.meshes) :], seams=seams)
        cut = self.curves is not None and self.curves.shapes
        self.near_cuts = NearCuts(self.curves) if cut else None
        horizons = Horizons(geometry, moving[: len(geometry.meshes)] | turning)
        self.horizons = horizons if len(horizons) else None
        #: How many edges, then cuts through faces, then faces with horizons, then pieces of curves there are, and then
        #: of cuts through analytic shapes.
        cuts, of_curves = len(faces) if len(edges) else 0, (self.curves, self.near_cuts)
        self.counts = (len(edges), cuts, len(horizons), *(len(c) if c is not None else 0 for c in of_curves))

    def beside_texture(self, at: Placed, chosen: Chosen) -> mi.Float:
        """How much farther beside lines of textures to look: scene units."""
        if self.pieces is None:
            return mi.Float(0)
        piece = dr.gather(mi.UInt32, self.pieces, chosen.edge)
        there = chosen.is_edge & (piece > 0)
        return dr.select(there, self.textures.beside(at.positions, dr.select(there, piece - 1, 0)), 0)

    @property
    def any_smooth(self) -> bool:
        """Are there edges with interpolated normals?"""
        return self.edges is not None and self.edges.any_smooth

    def placed(self, sensor: mi.Sensor) -> Placed:
        return Placed(
            Projection(sensor),
            self.geometry.positions(),
            self.curves.frames() if self.curves is not None else None,
            normals(self.geometry) if self.horizons is not None else None,
        )

    def choose(self, lengths: mi.Float, sampler: mi.Sampler, count: int) -> Chosen:
        """Choose edges in proportion to their length on the film."""
        last = sum(self.counts) - 1
        quantised = mi.UInt64(dr.ceil(mi.Float64(lengths) / LENGTH_UNIT))
        cumulative = dr.cumsum(quantised)
        total = mi.Float64(dr.gather(mi.UInt64, cumulative, last))
        x = (mi.Float64(dr.arange(mi.UInt32, count)) + mi.Float64(sampler.next_1d())) * (total / count)
        whole = mi.UInt64(x)
        index = dr.binary_search(0, last, lambda i: dr.gather(mi.UInt64, cumulative, i) <= whole)
        size = mi.Float64(dr.gather(mi.UInt64, quantised, index))
        start = mi.Float64(dr.gather(mi.UInt64, cumulative, index)) - size
        along = dr.select(size > 0, dr.clip(mi.Float((x - start) / size), 0, dr.one_minus_epsilon(mi.Float)), 0)
        density = dr.select(total > 0, mi.Float(count * size / total), 0)
        # In this order: edges, cuts through faces, horizons, pieces of curves and of cuts.
        first = np.cumsum(self.counts).tolist()
        is_edge, is_line = index < first[0], index < first[1]
        is_horizon, is_curve = ~is_line & (index < first[2]), (index >= first[2]) & (index < first[3])
        is_cut = index >= first[3]
        edge = dr.select(is_edge, index, 0)
        face, piece, cut = (
            dr.select(there, index - n, 0) for there, n in zip((is_horizon, is_curve, is_cut), first[1:], strict=False)
        )
        return Chosen(index, along, density, is_edge, is_line, is_horizon, is_curve, is_cut, edge, face, piece, cut)

    def find(self, at: Placed, chosen: Chosen) -> Found:
        """What is known of the points before they are attached."""
        projection, lens = at.projection, at.aperture_sample
        found = Found(mi.Vector2f(0), mi.Bool(False))
        if self.edges is not None:
            a, b = self._end_points(at, chosen.index)
            visible = projection.clip(a, b)
            found.t, dt = visible.parameter(chosen.along)
            found.along_film = projection.tangent(a, b, found.t, lens) * dt
            if self.edges.curves is not None:
                curved, p, along = self.edges.on_curve(at.positions, chosen.edge, found.t)
                on_film = projection.tangent(p, mi.Point3f(p + along), mi.Float(0), lens) * dt
                found.along_film = dr.select(chosen.is_edge & curved, on_film, found.along_film)
            found.valid = chosen.is_line & (visible.length > 0)
        if self.curves is not None:
            found.eye = -projection.view() if projection.orthographic else projection.eye(lens)
            c = found.curve = self._curve_point(at, chosen, found)
            on_film = projection.tangent(c.p, mi.Point3f(c.p + c.tangent), mi.Float(0), lens)
            found.along_film = dr.select(chosen.is_curve, on_film, found.along_film)
            found.valid |= chosen.is_curve & c.valid & (projection.film(c.p).z > projection.near)
        if self.near_cuts is not None:
            p, along, there = self.near_cuts.point(at.frames, chosen.cut, chosen.along, projection)
            on_film = projection.tangent(p, mi.Point3f(p + along), mi.Float(0), lens)
            found.along_film = dr.select(chosen.is_cut, on_film, found.along_film)
            found.valid |= chosen.is_cut & there
        if self.horizons is not None:
            h = self._horizon_point(at, chosen)
            across = lambda v: projection.tangent(h.p, mi.Point3f(h.p + v), mi.Float(0), lens)
            found.along_film = dr.select(chosen.is_horizon, across(h.tangent), found.along_film)
            found.facing = across(h.facing)
            if self.horizons.any_grid:
                of_grid = self.horizons.is_of_grid(chosen.face)
                found.facing = dr.select(of_grid, across(h.normal), found.facing)
                found.forward, found.normal = dr.select(of_grid, h.forward, 1), h.normal
            found.valid |= chosen.is_horizon & h.valid & (projection.film(h.p).z > projection.near)
        found.valid &= (chosen.density > 0) & dr.isfinite(dr.squared_norm(found.along_film))
        return found

    def point(self, at: Placed, chosen: Chosen, found: Found) -> mi.Point3f:
        """The points, world space; attached."""
        p = mi.Point3f(0)
        if self.edges is not None:
            p = dr.lerp(*self._end_points(at, chosen.index), found.t)
            if self.edges.curves is not None:
                curved, on_curve, _ = self.edges.on_curve(at.positions, chosen.edge, found.t)
                p = dr.select(chosen.is_edge & curved, on_curve, p)
        if self.curves is not None:
            p = dr.select(chosen.is_curve, self._curve_point(at, chosen, found).p, p)
        if self.near_cuts is not None:
            on_cut = self.near_cuts.point(at.frames, chosen.cut, chosen.along, at.projection)[0]
            p = dr.select(chosen.is_cut, on_cut, p)
        if self.horizons is not None:
            p = dr.select(chosen.is_horizon, self._horizon_point(at, chosen).p, p)
        return p

    def _curve_point(self, at: Placed, chosen: Chosen, found: Found) -> CurvePoint:
        return self.curves.point(at.frames, chosen.piece, chosen.along, found.eye, at.projection.orthographic)

    def _horizon_point(self, at: Placed, chosen: Chosen) -> HorizonPoint:
        eye, far = at.projection.viewer(at.aperture_sample), at.projection.orthographic
        return self.horizons.point(at.positions, at.normals, chosen.face, chosen.along, eye, far)

    def lune(self, at: Placed, chosen: Chosen, lights: mi.Vector4f | None) -> Lune | None:
        """From where the light comes that jumps at edges which only the planes of their faces make a boundary; active
        where it comes from nowhere else. None if there are no such edges. lights : see `Lights.places`."""
        if self.edges is None or not self.soft or not self.any_smooth:
            return None
        edge = chosen.edge
        soft = chosen.is_edge & dr.gather(mi.Bool, self.spreads, edge) & ~self._jumps(at, edge, lights)
        a, b = self.edges.end_points(at.positions, edge)
        first, second = self.edges.normals(at.positions, edge)
        return Lune.between(b - a, (first, -second), soft)

    # ---------------------- Lengths ----------------------

    def _jumps(self, at: Placed, edge: mi.UInt32, lights: mi.Vector4f | None, creases: bool = True) -> mi.Bool:
        """Does more jump at the edge, as seen from the sensor, than soft light that the planes of its faces hide?
        creases : do those between faces that are both seen count?"""
        projection = at.projection
        jumps = self.edges.is_boundary(
            at.positions,
            edge,
            projection.eye(),
            view=projection.view() if projection.orthographic else None,
            radius=projection.lens_radius(),
            geometry=self.geometry if creases else None,
        )
        if lights is not None:
            jumps |= self.edges.is_silhouette_of_any(at.positions, edge, lights)
        if self.edges.grids.any:
            # The outlines of grids are among the horizons.
            grids = self.edges.grids
            jumps &= ~grids.are(edge) | grids.are_open(edge) | self.edges.is_flat(edge)
        return jumps

    def visible_lengths(self, at: Placed, lights: mi.Vector4f | None, by_angle: bool) -> mi.Float:
        """Length inside the frame of each edge, cut, horizon and piece of a curve, 0 where nothing can jump: pixels on
        the film; less where little jumps; of horizons and curves, an estimate.

        by_angle : does the noise of creases fall with their angle, too?
        """
        lengths, projection, positions = [], at.projection, at.positions
        if self.edges is not None:
            edge, face = (dr.arange(mi.UInt32, n) for n in self.counts[:2])
            jumps = self._jumps(at, edge, lights)
            for a, b in (self.edges.end_points(positions, edge), self._cut(at, face)):
                lengths.append(projection.clip(a, b).length)
            # The less faces turn, the less their planes hide: about as the square of the angle.
            bend = mi.Float(0)
            if self.soft and self.edges.any_smooth:
                bend = dr.select(self.dark, 0, self.edges.bend(positions, edge) * lengths[0])
            lengths[0] = dr.select(jumps, lengths[0], bend)
            if self.matt is not None and by_angle:
                lengths[0] *= self._part_of_crease(at, edge)
        if self.horizons is not None:
            face = dr.arange(mi.UInt32, self.counts[2])
            eye, far, radius = projection.viewer(), projection.orthographic, projection.lens_radius()
            a, b, possible = self.horizons.chords(positions, at.normals, face, eye, far, radius)
            length = projection.clip(a, b).length
            lengths.append(dr.select(possible, length, 0))
        if self.curves is not None:
            lengths.append(self._curve_length(at))
        if self.near_cuts is not None:
            lengths.append(self._length_of_cuts(at))
        return dr.concat(lengths) if len(lengths) > 1 else lengths[0]

    def _part_of_crease(self, at: Placed, edge: mi.UInt32) -> mi.Float:
        """The less a matt surface turns at a crease, the less jumps there: about as the angle. 1 at all other edges."""
        crease = dr.gather(mi.Bool, self.matt, edge) & ~self._jumps(at, edge, None, creases=False)
        turn = self.edges.turn(at.positions, self.geometry.normals(), edge)
        return dr.select(crease, dr.clip(turn, LEAST, 1), 1)

    def _curve_length(self, at: Placed) -> mi.Float:
        """About the length of each piece of a curve, 0 only where it is certainly out of the frame."""
        projection, frames = at.projection, at.frames
        piece = dr.arange(mi.UInt32, self.counts[3])
        eye = -projection.view() if projection.orthographic else projection.eye()
        points = [
            projection.film(self.curves.point(frames, piece, mi.Float(t), eye, projection.orthographic).p)
            for t in (0, 0.5, 1)
        ]
        in_front = [q.z > projection.near for q in points]
        return self._length_through(projection, points, in_front)

    def _length_of_cuts(self, at: Placed) -> mi.Float:
        """The same of the cuts of the near clipping plane through analytic shapes."""
        piece, points, there = dr.arange(mi.UInt32, self.counts[4]), [], []
        for t in (0, 0.5, 1):
            p, _, valid = self.near_cuts.point(at.frames, piece, mi.Float(t), at.projection)
            points.append(at.projection.film(p))
            there.append(valid)
        return self._length_through(at.projection, points, there)

    @staticmethod
    def _length_through(projection: Projection, points: list[FilmPoint], in_front: list[mi.Bool]) -> mi.Float:
        """About the length of pieces of curves inside of the frame, by three points of each. in_front : which of these
        are there, and not behind the viewer."""
        lower, upper = projection.frame
        start, middle, end = (q.position() for q in points)
        length = dr.norm(middle - start) + dr.norm(end - middle)
        size = dr.norm(mi.Vector2f(upper - lower))
        # Another point of the lens may see all of it elsewhere.
        blur = sum(projection.blur(q) / dr.abs(q.w) for q in points)
        outside = mi.Bool(False)
        for i in (0, 1):
            outside |= (middle[i] + length + blur < lower[i]) | (middle[i] - length - blur > upper[i])
        whole = in_front[0] & in_front[1] & in_front[2] & dr.isfinite(length)
        length = dr.select(outside, 0, dr.minimum(length, size) + LENGTH_UNIT)
        length = dr.select(whole, length, dr.select(in_front[0] | in_front[1] | in_front[2], size, 0))
        return length

    def _end_points(self, at: Placed, index: mi.UInt32) -> tuple[mi.Point3f, mi.Point3f]:
        """End points of edges, or beyond their number of cuts: world space."""
        edges, faces = self.counts[:2]
        is_edge, is_face = index < edges, (index >= edges) & (index < edges + faces)
        edge = self.edges.end_points(at.positions, dr.select(is_edge, index, 0))
        cut = self._cut(at, dr.select(is_face, index - edges, 0))
        return tuple(dr.select(is_edge, e, c) for e, c in zip(edge, cut, strict=True))

    def _cut(self, at: Placed, face: mi.UInt32) -> tuple[mi.Point3f, mi.Point3f]:
        """End points of the cut of the near clipping plane through faces; NaN where there is none. World space."""
        projection = at.projection
        corners = [dr.gather(mi.Point3f, at.positions, dr.gather(mi.UInt32, corner, face)) for corner in self.corners]
        depth = [projection.film(p).z - projection.near for p in corners]
        a, b, crossed = cut_by_plane(corners, depth)
        return dr.select(crossed, a, dr.nan), dr.select(crossed, b, dr.nan)
