"""All that can be an outline in a scene: edges of meshes, found by a tree, and the curves of other shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.geometry.beside import EDGE_ON, are_edge_on, beside_edge
from rimlight.edge_sampling.geometry.curves import PIECES, Curves
from rimlight.edge_sampling.geometry.edges import Edges
from rimlight.edge_sampling.geometry.grids import grids_of
from rimlight.edge_sampling.geometry.meshes import Geometry, inner

from .edge_tree import EdgeTree
from .sampling import EdgeSample, sample_edge
from .views import View

#: Part of the samples that are for curves, where there are edges, too.
CURVE_PART = 0.5

#: An edge on a surface lies behind it if its faces rise from that, away from the viewer, by more than this: sine of the
#: angle.
RISES = 1e-3


@dataclass
class Placement:
    """Where shapes are, attached to their motion.

    positions : mi.Float, (3 V,), vertices of all meshes, world space.
    frames : mi.Float, frames of analytic shapes and control points of tubes, see `Curves.frames`; None: there are none.
    """

    positions: mi.Float
    frames: mi.Float | None


@dataclass
class OutlinePoint:
    """A point of an edge or a curve.

    p : mi.Point3f, world space; attached to its placement.
    tangent : mi.Vector3f, dp/dt, where t is the parameter that was sampled. Detached.
    inwards : two vectors from p towards the faces on the two sides of an edge. Detached.
    is_line : is it on a line in which shapes cut through each other? Then both faces go on beyond it.
    slack : how far from p what is rendered may lie, scene units: 0 but for grids and tubes. concave : is it on an edge
        of a grid that is bent inwards?
    slides : is it on a contour, which slides over its surface? crosses : on a line of a texture that does?
    """

    p: mi.Point3f
    tangent: mi.Vector3f
    inwards: tuple[mi.Vector3f, mi.Vector3f]
    is_line: mi.Bool
    slides: mi.Bool
    slack: mi.Float
    concave: mi.Bool
    crosses: mi.Bool

    @property
    def normals(self) -> tuple[mi.Vector3f, mi.Vector3f]:
        """Normals of the faces on both sides of an edge: of equal sense, not normalised."""
        return dr.cross(self.tangent, self.inwards[0]), dr.cross(self.inwards[1], self.tangent)

    def are_lit_along(self, d: mi.Vector3f) -> list[mi.Bool]:
        """Along which of its two faces does light shine, in the direction d, up to rounding?"""
        return [are_edge_on(n, d, 4 * EDGE_ON) for n in self.normals]

    def outward(self, across: mi.Vector3f, d: mi.Vector3f, either: bool = False) -> mi.Float:
        """The side of a silhouette on which its faces are not: the sign of `across`, (N,); 0 where they are on both.

        across : a direction across the edge and the line of sight. d : along that, from the viewer. either : is an edge
            along one of whose faces light shines a silhouette whatever the other one does? Otherwise, such a face faces
            away.
        """
        faces = [(dr.dot(n, d) < 0) & ~are_edge_on(n, d) for n in self.normals]
        differ = faces[0] != faces[1]
        if either:
            along = self.are_lit_along(d)
            differ |= along[0] != along[1]
        inwards = [dr.dot(v, across) for v in self.inwards]
        inwards = dr.select(dr.abs(inwards[0]) > dr.abs(inwards[1]), inwards[0], inwards[1])
        outward = dr.select(differ, -dr.sign(inwards), 0)
        # What is bent inwards is seen from the side of its faces.
        return dr.select(self.concave, -outward, outward)

    @property
    def sign(self) -> mi.Float:
        """With which sign a silhouette counts: −1 where triangles of a grid are bent inwards. There, the line of all
        silhouettes runs back, so that with this sign it is as long as that of the surface."""
        return dr.select(self.concave, mi.Float(-1), 1)

    def is_behind(self, n: mi.Vector3f, ω: mi.Vector3f) -> mi.Bool:
        """Do its faces lie behind a surface in which the point is? Then that hides the edge. Where shapes cut through
        each other, both go on in front of it.

        n : normal of the surface. ω : from the viewer; both of unit length.
        """
        rises = [dr.mulsign(dr.dot(v, n), dr.dot(n, ω)) > RISES * dr.norm(v) for v in self.inwards]
        return rises[0] & rises[1] & ~self.slides & ~self.is_line


class Silhouettes:
    """Chooses points on the edges and curves of a scene, as a viewer sees them.

    Parameters
    ----------
    geometry : the shapes.
    edges : their edges, on the host.
    moving : see `Geometry.moving`. None: take all as moving.
    lamps : shapes whose borders with other shapes count from wherever they are seen: see `DividedLight`.
    sliding : meshes over which the lines of their textures move: these count from wherever they are seen.

    Moving edges are a group of their own, so that viewers that stand still need not look at the others.
    """

    _NUMBERS = ("count", "groups", "centre", "_first_texture", "_first_line", "_still", "_crosses")
    DRJIT_STRUCT = dict.fromkeys(("tree", "curves", "lines", "textures", "grids", *_NUMBERS))  # for `dr.freeze`

    def __init__(
        self,
        geometry: Geometry,
        edges: Edges,
        moving: tuple[bool, ...] | None,
        lamps: Sequence[mi.Shape] = (),
        sliding: Sequence[mi.Shape] = (),
    ):
        self.geometry = geometry
        #: At which textures jump; they are the last edges but for `lines`.
        self.textures = geometry.textures
        #: In which shapes cut through each other; they are the last edges.
        self.lines = geometry.lines
        #: What stands for their surfaces is among the edges.
        self.grids = grids_of(geometry)
        self.count = len(edges)
        first_line = self.count - int(edges.is_line.sum())
        first_texture = first_line - (self.textures.capacity if self.textures is not None else 0)
        self._first_texture, self._first_line = (dr.opaque(mi.UInt32, n) for n in (first_texture, first_line))
        flags = lambda found: mi.Bool(found if len(found) else [False])  # Dr.Jit 1.5 cannot freeze empty arrays
        crosses = (np.arange(self.count) >= first_texture) & ~edges.is_line & _are_of(geometry, edges, sliding)
        self._crosses = flags(crosses)
        moves = np.ones(len(edges), bool)
        if moving is not None:
            moves = edges.is_line | crosses | np.array(moving, bool)[edges.mesh].any(axis=1)
        self._still = flags(~moves)
        counts = np.ones(len(edges), bool)
        if self.textures is not None:
            counts[first_texture:first_line] = ~self.textures.fine | crosses[first_texture:first_line]
        groups = [np.flatnonzero(m) for m in (moves & counts, ~moves & counts) if m.any()]
        #: Number of groups of edges.
        self.groups = len(groups)
        always = _borders(geometry, edges, lamps) | crosses
        self.tree = EdgeTree(geometry, edges, groups, always) if groups else None
        others = geometry.analytic or geometry.tubes
        self.curves = Curves(geometry.analytic, geometry.joints, geometry.tubes) if others else None
        self.centre = self.tree.centre if self.tree is not None else mi.Point3f(0)

    def __len__(self) -> int:
        """Number of edges, and of pieces of curves."""
        return self.count + (len(self.curves) if self.curves is not None else 0)

    @property
    def moving_edges(self) -> np.ndarray:
        """Numbers of the edges that move, (M,), uint32, but for `textures` and `lines`."""
        still = np.array(self._still)[: self._first_texture[0]]
        return np.flatnonzero(~still).astype(np.uint32)

    @property
    def leaves(self) -> int:
        """Number of leaves of the trees over the edges."""
        return self.tree.leaves if self.tree is not None else 0

    def refit(self) -> None:
        """Follow the vertices. To be called before sampling."""
        if self.tree is not None:
            self.tree.refit(dr.detach(self.geometry.positions()))

    def placement(self) -> Placement:
        """Where everything is. Attached, if gradients are not suspended."""
        return Placement(self.geometry.positions(), self.curves.frames() if self.curves is not None else None)

    def sample(
        self,
        placement: Placement,
        view: View,
        sampler: mi.Sampler,
        use: list[mi.Float | float],
        *,
        choice: mi.Float,
        active: mi.Bool,
    ) -> EdgeSample:
        """Choose an edge or a curve, and a point on it: `sample_edge`, which tells the arguments. Pieces of curves are
        numbered after the edges."""
        if self.curves is None:
            return sample_edge(self.tree, view, sampler, use, choice=choice, active=active)
        part = CURVE_PART if self.tree is not None else 1.0
        on_curve = choice < part
        curve = self._sample_curve(placement, view, sampler, dr.minimum(choice / part, dr.one_minus_epsilon(mi.Float)))
        curve.density *= part
        if self.tree is None:
            return curve
        choice = dr.clip((choice - part) / (1 - part), 0, dr.one_minus_epsilon(mi.Float))
        edge = sample_edge(self.tree, view, sampler, use, choice=choice, active=active & ~on_curve)
        edge.density *= 1 - part
        return dr.select(on_curve, curve, edge)

    def _sample_curve(self, placement, view, sampler, choice) -> EdgeSample:
        """Curves in proportion to how large their shapes appear, and uniformly along them."""
        eye = dr.select(self._far(view), mi.Point3f(view.p), mi.Point3f(view.p + self.centre))

        def look(i, total, kept, weight, choice):
            centre, radius = self.curves.centre(placement.frames, i)
            d = dr.select(self._far(view), -mi.Vector3f(eye), centre - eye)
            distance = dr.norm(d)
            w = dr.select(self._far(view), radius, radius / dr.maximum(distance, radius))
            beyond = (dr.dot(view.n, d) < -radius) & ~self._far(view)
            if view.cone is not None:
                axis, cos = view.cone.axis, view.cone.cos
                # Outside, if the angle to the cone is more than that of the ball.
                along, off = dr.dot(axis, d), dr.norm(dr.cross(axis, d))
                beyond |= ~view.cone.everything & (off * cos - along * view.cone.sin > radius)
            w = dr.select(beyond, 0, w)
            total += w
            p = dr.select(total > 0, w / total, 0)
            taken = choice < p
            choice = dr.select(taken, choice / p, (choice - p) / (1 - p))
            return i + 1, total, dr.select(taken, i, kept), dr.select(taken, w, weight), choice

        width = dr.width(choice)
        state = (dr.zeros(mi.UInt32, width), dr.zeros(mi.Float, width), dr.zeros(mi.UInt32, width))
        _, total, curve, weight, choice = dr.while_loop(
            (*state, dr.zeros(mi.Float, width), choice), lambda i, *_: i < self.curves.count, look, label="curves"
        )
        x = dr.clip(choice, 0, dr.one_minus_epsilon(mi.Float)) * PIECES
        piece = dr.minimum(mi.UInt32(x), PIECES - 1)
        t = sampler.next_1d()
        density = dr.select(total > 0, weight / (total * PIECES), 0)
        return EdgeSample(self.count + curve * PIECES + piece, t, density)

    @staticmethod
    def _far(view: View) -> mi.Bool:
        return mi.Bool(False) if view.far is None else view.far

    def crease(self, sample: EdgeSample, outline: OutlinePoint) -> mi.Float:
        """About how much jumps at a point if both faces are seen, see `DeviceEdges.crease`."""
        of_rims = mi.Float(0)
        if self.curves is not None:
            piece = dr.select(sample.edge < self.count, 0, sample.edge - self.count)
            of_rims = dr.select(self.curves.joined(piece), mi.Float(1), 0)
        if self.tree is None:
            return of_rims
        first, second = (dr.normalize(n) for n in outline.normals)
        edge = dr.select(sample.edge < self.count, sample.edge, 0)
        of_edges = self.tree.device_edges.crease(edge, dr.norm(dr.cross(first, second)))
        of_edges = dr.select(self.tree.device_edges.rests(edge), 0, of_edges)
        return dr.select(sample.edge < self.count, of_edges, of_rims)

    def preferred(self, sample: EdgeSample, use: list[mi.Float | float]) -> mi.Float:
        """How much the group is preferred in which an edge is, see `sample_edge`."""
        if len(use) < 2:
            return mi.Float(1)
        still = (sample.edge < self.count) & dr.gather(mi.Bool, self._still, dr.minimum(sample.edge, self.count - 1))
        return dr.select(still, use[1], use[0])

    def is_moving_edge(self, sample: EdgeSample) -> mi.Bool:
        """Is it on one of `moving_edges`?"""
        on_edge = sample.edge < self._first_texture
        return on_edge & ~dr.gather(mi.Bool, self._still, dr.select(on_edge, sample.edge, 0))

    def only_bends(self, sample: EdgeSample, outline: OutlinePoint) -> mi.Bool:
        """Is it on an edge across which nothing differs but the planes of two smooth-shaded faces?"""
        if self.tree is None:
            return mi.Bool(False)
        of_mesh = (sample.edge < self.count) & (outline.slack == 0)
        return of_mesh & self.tree.device_edges.is_smooth(dr.minimum(sample.edge, self.count - 1))

    def beside(
        self, scene: mi.Scene, placement: Placement, sample: EdgeSample, p: mi.Point3f, x: mi.Point3f
    ) -> mi.Float:
        """How far beside a point p that was sampled to look from x: scene units."""
        aside = beside_edge(p, x)
        if self.curves is not None:
            piece = dr.select(sample.edge < self.count, 0, sample.edge - self.count)
            farther = self.curves.blur(placement.frames, piece, x)
            if self.curves.tubes is not None:
                farther += self.curves.point(placement.frames, piece, sample.t, x).slack
            aside += dr.select(sample.edge < self.count, 0, farther)
        if self.tree is None:
            return aside
        active = sample.edge < self.count
        edge = dr.select(active, sample.edge, 0)
        edges = self.tree.device_edges
        farther = edges.farther(scene, placement.positions, edge, p, x - p) + edges.grids.slack(edge)
        if self.textures is not None:
            on_texture = (edge >= self._first_texture) & (edge < self._first_line)
            piece = dr.select(on_texture, edge - self._first_texture, 0)
            farther += dr.select(on_texture, self.textures.beside(placement.positions, piece), 0)
        return aside + dr.select(active, farther, 0)

    def point(
        self,
        placement: Placement,
        sample: EdgeSample,
        eye: mi.Point3f,
        far: mi.Bool | bool = False,
        *,
        is_light: bool = False,
    ) -> OutlinePoint:
        """The point that was sampled, as seen from `eye`, world space; or at infinity, in the direction `eye`.

        is_light : do rays go towards the eye, and not from it?
        """
        if self.tree is not None:
            on_edge = sample.edge < self.count
            index = dr.select(on_edge, sample.edge, 0) if self.curves is not None else sample.edge
            edges = self.tree.device_edges
            a, b = edges.end_points(placement.positions, index)
            p = dr.lerp(a, b, sample.t)
            with dr.suspend_grad():
                inwards = tuple(dr.detach(o - p) for o in edges.opposite(placement.positions, index))
                is_line = index >= self._first_line if self.lines else mi.Bool(False)
                of_grid = edges.grids.slack(index), edges.is_concave(placement.positions, index)
                crosses = dr.gather(mi.Bool, self._crosses, index) if self.textures is not None else mi.Bool(False)
                point = OutlinePoint(p, dr.detach(b - a), inwards, is_line, mi.Bool(False), *of_grid, crosses)
            if edges.curves is not None:
                curved, on_curve, tangent = edges.on_curve(placement.positions, index, sample.t)
                point.p = dr.select(curved, on_curve, point.p)
                point.tangent = dr.select(curved, tangent, point.tangent)
            if self.curves is None:
                return point
        piece = sample.edge - self.count
        if self.tree is not None:
            piece = dr.select(on_edge, 0, piece)
        c = self.curves.point(placement.frames, piece, sample.t, eye, far, is_light=is_light)
        # Where there is none, both sides seem to have a face.
        inwards = (c.inwards, dr.select(c.valid, c.other, -c.inwards))
        no = mi.Bool(False)
        on_curve = OutlinePoint(c.p, c.tangent, inwards, no, c.slides, c.slack, no, no)
        if self.tree is None:
            return on_curve
        choose = lambda x, y: dr.select(on_edge, x, y)
        inwards = tuple(choose(x, y) for x, y in zip(point.inwards, on_curve.inwards, strict=True))
        p, tangent = choose(point.p, on_curve.p), choose(point.tangent, on_curve.tangent)
        slack, concave = dr.select(on_edge, point.slack, c.slack), point.concave & on_edge
        is_line, crosses = point.is_line & on_edge, point.crosses & on_edge
        return OutlinePoint(p, tangent, inwards, is_line, c.slides & ~on_edge, slack, concave, crosses)


def _borders(geometry: Geometry, edges: Edges, lamps: Sequence[mi.Shape]) -> np.ndarray:
    """Which edges are between a lamp and another mesh: (E,), bool."""
    return _are_of(geometry, edges, lamps) & (edges.mesh[:, 0] != edges.mesh[:, 1])


def _are_of(geometry: Geometry, edges: Edges, shapes: Sequence[mi.Shape]) -> np.ndarray:
    """Which edges have a face of one of these shapes: (E,), bool."""
    known = {int(s.ptr) for s in shapes}
    are = np.array([int(inner(m).ptr) in known for m in geometry.meshes] or [False])
    return are[edges.mesh].any(axis=1)
