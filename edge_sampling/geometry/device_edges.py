"""The edges of a scene on the device: end points, and which of them are boundaries as seen from a point."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.rays import lift, lift_beyond

from .beside import BESIDE_LINE, BESIDE_MASK, are_edge_on, beside_edge, compare_depth, overhang, passes, rounding
from .edges import EdgeKind, Edges
from .grid_edges import GridEdges
from .meshes import Geometry, bends_light, lets_rays_through

#: Faces whose normals differ by less (sine of the angle) count as coplanar; vertex normals, as equal.
COPLANAR = 1e-5

#: How far beside the edges of glass to look, in units of the offset of rays that start there, times the cotangent of
#: the angle between the faces: closer, rays through the mesh start beyond the other face.
BEHIND = 8

#: And beside sharp edges, in units of `beside_edge`, times the cotangent of the angle between the faces, but at most so
#: large a cotangent. Closer, rays meet both faces at the same distance, up to rounding, often the one that faces away.
BESIDE_SHARP = 0.5, 1000

#: Which meshes glass and masks are.
KINDS = bends_light, lets_rays_through


class DeviceEdges:
    """Topology of `Edges` as Dr.Jit arrays. Vertex positions are given with each call, since they change.

    geometry : the meshes.
    """

    # What a frozen function depends on (`dr.freeze`): every attribute that is read when sampling.
    _OF_EDGES = ("_ends", "_part", "_opposite", "_kind", "_two_faces", "_few_faces", "_is_line", "_glass", "_mask")
    _ANY = ("any_smooth", "_any_glass", "_any_lines", "_any_split", "_any_joined", "_any_through", "_first_line")
    DRJIT_STRUCT = dict.fromkeys(("count", "_kinds", "curves", "_lines", "grids", *_ANY, *_OF_EDGES))

    def __init__(self, edges: Edges, geometry: Geometry):
        # Copied, since Dr.Jit maps NumPy's memory: two arrays on the same memory make `dr.freeze` record anew.
        index = lambda a: mi.UInt32(np.array(a))
        self.count = len(edges)
        self._ends = [[index(edges.vertices[:, side, k]) for k in (0, 1)] for side in (0, 1)]
        self._opposite = [index(edges.opposite[:, side]) for side in (0, 1)]
        self._kind = index(edges.kind)
        self._kinds = frozenset(edges.kind)
        #: Are there edges with interpolated normals?
        self.any_smooth = not self._kinds.isdisjoint({EdgeKind.SMOOTH, EdgeKind.SPLIT})
        self._two_faces = mi.Bool(edges.count == 2)
        self._few_faces = mi.Bool(edges.count <= 2)
        self._is_line = mi.Bool(np.array(edges.is_line))
        glass, mask = (np.array([is_so(m) for m in geometry.meshes] or [False])[edges.mesh].any(1) for is_so in KINDS)
        self._glass, self._mask = mi.Bool(glass & ~edges.is_line), mi.Bool(mask & ~edges.is_line)
        #: Are there lines in which shapes cut through each other?
        self._any_lines = bool(edges.is_line.any())
        self._lines = geometry.lines if self._any_lines else ()
        #: The curves among them, which come first.
        self.curves = self._lines[0] if self._lines and not self._lines[0].straight else None
        self._first_line = int(np.argmax(edges.is_line)) if self._any_lines else 0
        shapes = (*geometry.known, *geometry.others)
        #: Is there a surface that lets rays through?
        self._any_through = any(lets_rays_through(s) for s in shapes)
        #: And one that bends them, so that they start on its other side?
        self._any_glass = any(bends_light(s) for s in shapes)
        self._any_split = bool((edges.vertices[:, 0] != edges.vertices[:, 1]).any())
        #: Are there edges made of sides that lie on one another (`close_cracks`), and of which parts of these?
        self._any_joined = bool(edges.joined.any())
        number = lambda a: mi.Float(np.array(a, np.float32))
        #: Which edges stand for the surface of a grid.
        self.grids = GridEdges(geometry, edges)
        ends = [[number(edges.part[:, side, k]) for k in (0, 1)] for side in (0, 1)]
        self._part = ends if self._any_joined else None

    def end_points(self, positions: mi.Float, edge: mi.UInt32) -> tuple[mi.Point3f, mi.Point3f]:
        """End points of edges, world space; of split vertices the mean, so that all copies have a gradient."""
        a, b = self._points_of_side(positions, edge, 0)
        if self._any_split:
            c, d = self._points_of_side(positions, edge, 1)
            a, b = 0.5 * (a + c), 0.5 * (b + d)
        return a, b

    def _points_of_side(self, positions, edge, side):
        a, b = (dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, self._ends[side][k], edge)) for k in (0, 1))
        if not self._any_joined:
            return a, b
        s, t = (dr.gather(mi.Float, part, edge) for part in self._part[side])
        return dr.select(s == 0, a, dr.lerp(a, b, s)), dr.select(t == 1, b, dr.lerp(a, b, t))

    def _crack(self, positions: mi.Float, edge: mi.UInt32) -> mi.Float | float:
        """How far apart the two sides of an edge are at most: scene units. Known where some were joined."""
        if not self._any_joined:
            return 0.0
        sides = [self._points_of_side(positions, edge, side) for side in (0, 1)]
        return dr.maximum(*(dr.norm(p - q) for p, q in zip(*sides, strict=True)))

    def on_curve(self, positions: mi.Float, edge: mi.UInt32, t: mi.Float) -> tuple[mi.Bool, mi.Point3f, mi.Vector3f]:
        """Which edges are pieces of curves; their points t, world space, attached, and the derivatives with respect to
        t, detached."""
        curved, piece = self._piece(edge)
        return curved, *self.curves.point(positions, piece, t)

    def _piece(self, edge: mi.UInt32) -> tuple[mi.Bool, mi.UInt32]:
        """Which edges are pieces of curves, and which ones."""
        return self._number(edge, self._first_line, self.curves.capacity)

    @staticmethod
    def _number(edge: mi.UInt32, first: int, count: int) -> tuple[mi.Bool, mi.UInt32]:
        """Which edges are among `count` of them from `first` on, and where there."""
        among = (edge >= first) & (edge < first + count)
        return among, dr.select(among, edge - first, 0)

    def normals(self, positions: mi.Float, edge: mi.UInt32) -> list[mi.Vector3f]:
        """Normals of the faces on both sides, not normalised.

        Both turn about the edge in the same sense: where the faces lie on the same side of the view plane, as seen
        from somewhere, their normals point to the same side. The first is that of its face, as its vertices turn.
        """
        a, b = self.end_points(positions, edge)
        return [dr.cross(b - a, o - a) for o in self.opposite(positions, edge)]

    def opposite(self, positions: mi.Float, edge: mi.UInt32) -> list[mi.Point3f]:
        """The third vertex of the face on each side, world space."""
        return [dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, o, edge)) for o in self._opposite]

    def is_hidden(
        self,
        positions: mi.Float,
        edge: mi.UInt32,
        p: mi.Point3f,
        eye: mi.Point3f,
        view: mi.Vector3f | None,
        rays: list[mi.Ray3f],
        met: list[mi.SurfaceInteraction3f],
        farther: mi.Float,
    ) -> mi.Bool:
        """Do two rays, close by on both sides of an edge, meet something else than what joins there?

        What jumps between them is another outline's then, and would count twice: one that lies on the film where the
        edge does, as in views along an axis of symmetry, or so close to it that it passes between the rays. Of an edge
        that is no silhouette, both faces must be seen, which excludes those at so grazing an angle that a ray has left
        its face, and met what lies beyond the face's other edges. A silhouette must be seen if a ray passes through
        both of its faces, unless one is narrower than the rays are apart. Where more meet, a ray must meet its plane.
        Where a face is seen edge-on, its other borders are at the same place of the film: a ray must meet a plane of
        the edge's, and none may meet something before it.

        p : a point of the edge that the rays pass, world space. eye, view : see `is_boundary`.
        met : what the rays meet. What lets rays through hides nothing. farther : how much farther they may be from the
        planes of its faces than rounding explains, scene units.
        """
        a, b = self.end_points(positions, edge)
        normals = [dr.normalize(dr.cross(b - a, o - a)) for o in self.opposite(positions, edge)]
        covers, shown, crack = [], [], self._crack(positions, edge)
        reached, before = mi.Bool(False), mi.Bool(False)
        for ray, si in zip(rays, met, strict=True):
            through = self._lets_through(si)
            slack = rounding(p, ray.o) + crack + farther
            passed = [passes(ray, p, [a, b, o]) for o in self.opposite(positions, edge)]
            there = [through | (dr.abs_dot(n, si.p - p) <= slack) for n in normals]
            covers.append(passed[0] & passed[1])
            shown.append((passed[0] & there[0]) | (passed[1] & there[1]))
            at_p, nearer = compare_depth(p, ray, si, slack)
            reached |= through | at_p
            before |= ~through & nearer
        of = lambda kind: dr.gather(mi.Bool, kind, edge)
        fold = of(self._two_faces) & ~self.is_silhouette(positions, edge, eye, view)
        covered = (covers[0] | covers[1]) & ~(shown[0] | shown[1])
        hidden = dr.select(fold, ~(shown[0] & shown[1]), covered)
        hidden = dr.select(of(self._few_faces), hidden, ~reached)
        edge_on = [are_edge_on(n, rays[0].d) for n in normals]
        hidden |= (edge_on[0] | edge_on[1]) & (before | ~reached)
        if self._any_lines:
            hidden |= fold & self.rests(edge)
            hidden_line = self._is_hidden_line(positions, edge, p, rays, met)
            hidden_line |= self._repeats_silhouette(positions, edge, eye, view)
            hidden = dr.select(of(self._is_line), hidden_line, hidden)
        return hidden

    # ---------------------- Of grids ----------------------

    def side_of_crease(
        self,
        positions: mi.Float,
        normals: mi.Float,
        edge: mi.UInt32,
        t: mi.Float,
        p: mi.Point3f,
        si: mi.SurfaceInteraction3f,
    ) -> mi.UInt32:
        """See `GridEdges.side`, of the point p = (1 − t) a + t b. normals : see `grids.normals`."""
        n = dr.normalize(dr.lerp(*self._points_of_side(normals, edge, 0), t))
        return self.grids.side(edge, p, n, sum(dr.norm(o - p) for o in self.opposite(positions, edge)), si)

    def is_concave(self, positions: mi.Float, edge: mi.UInt32) -> mi.Bool:
        """Which edges of grids are bent inwards? As silhouettes, these count with the opposite sign."""
        if not self.grids.any:
            return mi.Bool(False)
        a, b = self.end_points(positions, edge)
        first, second = self.opposite(positions, edge)
        return self.grids.are(edge) & (dr.dot(dr.cross(b - a, first - a), second - a) > 0)

    # ---------------------- What they look like ----------------------

    def _is_hidden_line(self, positions: mi.Float, edge: mi.UInt32, p: mi.Point3f, rays, met) -> mi.Bool:
        """Does one of two rays beside a line in which shapes cut through each other miss both?"""
        missed = mi.Bool(False)
        for ray, si in zip(rays, met, strict=True):
            slack = rounding(p, ray.o)
            there = dr.abs_dot(si.n, p - si.p) <= slack
            if self.curves is not None:
                curved, piece = self._piece(edge)
                there = dr.select(curved, self.curves.is_met(positions, piece, p, ray, si.p, slack), there)
            missed |= ~(si.is_valid() & there) & ~self._lets_through(si)
        return missed

    def rests(self, edge: mi.UInt32) -> mi.Bool:
        """Does an edge lie in another surface, through which its own one goes on? Then, unless it is a silhouette, a
        line counts in its place."""
        of_lines = [lines.rests for lines in self._lines if lines.straight]
        if not of_lines:
            return mi.Bool(False)
        ends = [dr.gather(mi.UInt32, end, edge) for end in self._ends[0]]
        of_mesh = (ends[0] < dr.width(of_lines[0])) & (ends[1] < dr.width(of_lines[0]))
        first, second = (dr.gather(mi.Bool, of_lines[0], end, of_mesh) for end in ends)
        return first & second

    def _repeats_silhouette(
        self, positions: mi.Float, edge: mi.UInt32, eye: mi.Point3f, view: mi.Vector3f | None
    ) -> mi.Bool:
        """Is a line in which shapes cut through each other an edge of one of them, and that a silhouette? Both sides of
        other lines lie in one plane."""
        a, _ = self.end_points(positions, edge)
        towards = -view if view is not None else eye - a
        first, second = self.normals(positions, edge)
        alike = (dr.dot(first, towards) > 0) == (dr.dot(second, towards) > 0)
        return alike & ~are_edge_on(first, towards) & ~are_edge_on(second, towards)

    def _lets_through(self, si: mi.SurfaceInteraction3f) -> mi.Bool:
        """Can rays go through a surface as if nothing was there?"""
        if not self._any_through:
            return mi.Bool(False)
        return si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Null)

    def is_silhouette(
        self, positions: mi.Float, edge: mi.UInt32, eye: mi.Point3f, view: mi.Vector3f | None = None
    ) -> mi.Bool:
        """Does one of the two faces face the eye, and the other not? See `is_boundary`.

        A face that is seen exactly edge-on, up to rounding, is between both: each of its borders with a face that is
        not is a silhouette, and `is_hidden` excludes all of them but the first.
        """
        a, _ = self.end_points(positions, edge)
        towards = -view if view is not None else eye - a
        first, second = self.normals(positions, edge)
        differ = (dr.dot(first, towards) > 0) == (dr.dot(second, towards) > 0)
        return differ | (are_edge_on(first, towards) != are_edge_on(second, towards))

    def is_fold(self, positions: mi.Float, edge: mi.UInt32, p: mi.Point3f, sight: mi.Vector3f) -> mi.Bool:
        """Do edges have faces on both sides, as seen along a line of sight through a point p of theirs?"""
        a, b = self.end_points(positions, edge)
        across = dr.cross(b - a, sight)
        sides = [dr.sign(dr.dot(o - p, across)) for o in self.opposite(positions, edge)]
        return dr.gather(mi.Bool, self._two_faces, edge) & (sides[0] != sides[1])

    def facing(
        self, normals: mi.Float, sign: mi.Float, edge: mi.UInt32, t: mi.Float, to_viewer: mi.Vector3f
    ) -> mi.Float:
        """Do the interpolated normals at points of edges face the viewer? +1: yes; −1: no; 0: there are none, or the
        two sides do not agree.

        normals : (3 V,). sign : (V,), their sign in Mitsuba, 0 where there are none. t : from the first end point to
        the second.
        """
        found = []
        for side in (0, 1):
            a, b = self._points_of_side(normals, edge, side)
            s = dr.gather(mi.Float, sign, dr.gather(mi.UInt32, self._ends[side][0], edge))
            found.append(dr.select(s == 0, 0, dr.sign(s * dr.dot(dr.lerp(a, b, t), to_viewer))))
        return dr.select(found[0] == found[1], found[0], 0)

    def bend(self, positions: mi.Float, edge: mi.UInt32) -> mi.Float:
        """By how much faces turn at an edge: square of the sine of the angle between their normals; 0 where these count
        as coplanar, or are not two. Detached."""
        first, second = (dr.normalize(n) for n in self.normals(positions, edge))
        sine = dr.norm(dr.cross(first, second))
        bends = dr.gather(mi.Bool, self._two_faces, edge) & (sine > COPLANAR) & ~self.grids.are(edge)
        return dr.select(bends, dr.square(sine), 0)

    def farther(
        self, scene: mi.Scene, positions: mi.Float, edge: mi.UInt32, p: mi.Point3f, to_viewer: mi.Vector3f
    ) -> mi.Float:
        """How much farther beside a point p of edges to look than rounding asks for: scene units. Detached.

        Rays start that far below the first face of glass, and so above the second, if they are closer to the edge than
        this times the cotangent of the angle between both. In a corner of less than 90° that is seen from inside, rays
        that leave one face start beyond the other.
        """
        of = lambda kind: dr.gather(mi.Bool, kind, edge)
        first, second = (dr.normalize(n) for n in self.normals(positions, edge))
        cotangent = dr.dot(first, second) / dr.norm(dr.cross(first, second))
        a, b = self.end_points(positions, edge)
        inside = dr.dot(dr.cross(first + second, b - a), to_viewer) > 0
        wedge = dr.select(of(self._glass) & of(self._two_faces), dr.clip(cotangent, 0, 1), 0)
        beyond = dr.select(of(self._mask), mi.Float(BESIDE_MASK), 0)
        if self._any_lines:
            normals = self._normals_of_line(positions, edge, p, to_viewer)
            below = overhang(*normals)
            if self._any_glass:
                below = dr.maximum(below, overhang(normals[0], -normals[1]))
            wedge = dr.select(of(self._is_line), below, BEHIND * wedge)
            if self._any_through:
                through = BESIDE_MASK / dr.maximum(dr.norm(dr.cross(*normals)), 1 / BESIDE_LINE[1])
                beyond = dr.select(of(self._is_line), through, beyond)
        else:
            wedge *= BEHIND
        farther = wedge * lift(scene, p) + self._crack(positions, edge)
        margin, most = BESIDE_SHARP
        sharp = dr.select(of(self._two_faces), dr.clip(cotangent, 0, most), 0)
        farther += dr.select(sharp > 0, margin * sharp * beside_edge(p, p + to_viewer), 0)
        # Where several faces meet, some of them may be as close as that to each other.
        margin, most = BESIDE_LINE
        corner = dr.select(of(self._few_faces), dr.select(inside & (sharp > 0), dr.minimum(sharp, most), 0), most)
        farther += dr.select(of(self._is_line), 0, margin * corner * lift(scene, p))
        if self.curves is not None:
            curved, piece = self._piece(edge)
            farther += dr.select(curved, self.curves.blur(positions, piece, p, to_viewer), 0)
        return dr.detach(farther + beyond * lift_beyond(scene, p))

    def _normals_of_line(
        self, positions: mi.Float, edge: mi.UInt32, p: mi.Point3f, to_viewer: mi.Vector3f
    ) -> list[mi.Vector3f]:
        """Of the two surfaces that cut each other in a line, towards the viewer."""
        normals, start = [mi.Vector3f(0), mi.Vector3f(0)], self._first_line
        for lines in self._lines:
            here, line = self._number(edge, start, lines.capacity)
            normals = [dr.select(here, m, n) for m, n in zip(lines.normals(positions, line, p), normals, strict=True)]
            start += lines.capacity
        return [dr.mulsign(n, dr.dot(n, to_viewer)) for n in normals]

    def is_smooth(self, edge: mi.UInt32) -> mi.Bool:
        """Are interpolated normals, and all else, the same on both sides?"""
        return dr.gather(mi.UInt32, self._kind, edge) == int(EdgeKind.SMOOTH)

    def is_flat(self, edge: mi.UInt32) -> mi.Bool:
        """Are both faces shaded with their own normals?"""
        return dr.gather(mi.UInt32, self._kind, edge) == int(EdgeKind.FLAT)

    def crease(self, edge: mi.UInt32, sine: mi.Float) -> mi.Float:
        """About how much what is seen jumps across an edge, though both of its faces are seen: 1 if something else than
        their shape differs, or the normals that shade do; if only their planes do, as `bend`.

        sine : of the angle between the normals of the faces.
        """
        kind = dr.gather(mi.UInt32, self._kind, edge)
        other = (kind == int(EdgeKind.JUMP)) | (kind == int(EdgeKind.SPLIT))
        if self.grids.any:
            sine = dr.select(self.grids.are(edge) & (kind == int(EdgeKind.SMOOTH)), 0, sine)
        bent = dr.select(kind == int(EdgeKind.FLAT), 1, dr.square(sine))
        return dr.select(other, 1, dr.select(sine > COPLANAR, bent, 0))

    def is_silhouette_of_any(self, positions: mi.Float, edge: mi.UInt32, places: mi.Vector4f) -> mi.Bool:
        """Is the edge a silhouette as seen from one of the `places`, see `Lights.places`? Detached."""
        a, _ = self.end_points(positions, edge)
        normals = self.normals(positions, edge)

        def look(k, found):
            place = dr.gather(mi.Vector4f, packed, k)
            towards = mi.Vector3f(place.x, place.y, place.z) - place.w * a
            return k + 1, found | (dr.dot(normals[0], towards) * dr.dot(normals[1], towards) > 0)

        packed, count, width = dr.ravel(places), dr.width(places), dr.width(edge)
        state = (dr.zeros(mi.UInt32, width), dr.full(mi.Bool, False, width))
        return dr.while_loop(state, lambda k, found: ~found & (k < count), look, label="silhouettes of lights")[1]

    def turn(self, positions: mi.Float, normals: mi.Float, edge: mi.UInt32) -> mi.Float:
        """By how much the normals that shade both sides of a crease differ: of flat faces, the sine of their angle; of
        split vertices, the length of their difference. 1 at all other edges."""
        kind = dr.gather(mi.UInt32, self._kind, edge)
        first, second = (dr.normalize(n) for n in self.normals(positions, edge))
        turn = dr.select(kind == int(EdgeKind.FLAT), dr.norm(dr.cross(first, second)), 1)
        if EdgeKind.SPLIT not in self._kinds:
            return turn
        return dr.select(kind == int(EdgeKind.SPLIT), self.normals_differ(normals, edge), turn)

    def normals_differ(self, normals: mi.Float, edge: mi.UInt32) -> mi.Float:
        """By how much the vertex normals of the two sides differ at most."""
        sides = [self._points_of_side(normals, edge, side) for side in (0, 1)]
        differences = [dr.norm(n - m) for n, m in zip(*sides, strict=True)]
        return dr.maximum(*differences)

    def is_boundary(
        self,
        positions: mi.Float,
        edge: mi.UInt32,
        eye: mi.Point3f,
        *,
        view: mi.Vector3f | None = None,
        radius: mi.Float | float = 0.0,
        geometry: Geometry | None = None,
    ) -> mi.Bool:
        """Is the edge a silhouette, or does something else jump across it? Detached.

        eye, view : the point that looks, or the direction in which an orthographic sensor does.
        radius : of a lens around the eye: silhouettes from any of its points are taken.
        geometry : where given, creases between faces that are both visible count, too (they matter for radiance, not
            for occlusion).
        """
        kind = dr.gather(mi.UInt32, self._kind, edge)
        boundary = kind == int(EdgeKind.JUMP)
        if self._kinds <= {EdgeKind.JUMP}:
            return boundary
        boundary |= self.is_silhouette(positions, edge, eye, view)
        a, _ = self.end_points(positions, edge)
        normal = self.normals(positions, edge)
        for n in normal:
            # A lens sees around the edge.
            boundary |= dr.abs(dr.dot(n, -view if view is not None else eye - a)) < dr.norm(n) * radius
        if geometry is not None and EdgeKind.FLAT in self._kinds:
            # By unit vectors: products of lengths could overflow in large scenes.
            folded = dr.norm(dr.cross(dr.normalize(normal[0]), dr.normalize(normal[1]))) > COPLANAR
            boundary |= (kind == int(EdgeKind.FLAT)) & folded
        if geometry is not None and EdgeKind.SPLIT in self._kinds:
            boundary |= (kind == int(EdgeKind.SPLIT)) & (self.normals_differ(geometry.normals(), edge) > COPLANAR)
        return boundary
