"""What every sample of a derivative holds fixed while the parameters change, and how the rest follows it.

A derivative may be taken under the integral over any sample space, as long as the boundaries move as the same space has
it: what the interior term holds fixed is what the sides of a boundary move with. This is the one place that decides it:

====================================  ======================================================================
what the camera sees                  the film position: the *ray* is fixed on the film, and moves with the camera;
                                      of fine textures, and of polished curved shapes, the *material point*
                                      (`first_points.py`)
every further vertex of a path        far from the vertex before: the *material point*, which follows its surface;
                                      close to it, or behind rough glass: the direction, so that the vertex
                                      slides over its surface
a point on a lamp                     the material point; close to one of the `CloseLamps`, the direction; in a
                                      narrow lobe, the direction relative to that
one side of a boundary                as the interior term has the point that is seen there
a point of a light without size       the light's own numbers: it goes where the light goes
what is infinitely far away           the direction; in a narrow lobe, relative to that
what a perfect mirror shows           the random numbers: the ray turns with the mirror
====================================  ======================================================================

With the solid angle written as area, dω = |cos θ_y| dA(y) / r², a material point y makes the integrand a product, of
which every factor follows the motion of x and y (Zhang et al. 2020, "Path-space differentiable rendering"). So what
moves together sees no motion at all.

Where two surfaces meet and only one of x and y moves, the change of 1 / r² has no finite variance. So scattered light
is divided: the part `far(r)` of what arrives from a point at the distance r is held at the material point, the rest in
its direction. Both parts add up to the whole, so that the division may be chosen at will (`Vicinity`). So is the light
of lamps that are close to what they light, and in narrow lobes (`divided_light.py`).

Through rough glass, a surface looks in few directions. Of a material point that moves out of them, the change relative
to its value is large. So what rough glass shows is held in its direction, however far it is; but not where there are
interpolated normals: what slides over such a mesh jumps at the edges of its faces (`boundaries/lune.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import drjit as dr
import mitsuba as mi

from .geometry.instances import surface_met
from .smooth_lamps import SmoothLamps

#: All that is known of a surface that is met, at a point that follows it.
FOLLOWS = mi.RayFlags.All | mi.RayFlags.FollowShape

#: Cosine below which a surface that is no mesh is taken to stand still. Where a fixed ray meets a curved one, and the
#: solid angle that an element of it covers, change as 1 / cos; single precision does not know cosines of 1e-4, and
#: single samples would outweigh all others. The loss is of this order, relative to what the surface itself contributes.
GRAZING = 1e-3

#: Radius of the vicinity of a vertex, relative to the distance of the camera from the first vertex of its path.
VICINITY = 0.2

#: Directions turn with a lobe up to so many widths from its axis.
REACH = 8

#: Nothing turns with lobes in the light of lamps that are seen smaller than so many widths.
WIDE = 1.5

#: Height over a tangent plane that is taken for rounding, in units in the last place of the coordinates.
FLUSH = 16


# ---------------------- Points ----------------------


def material_point(
    ray: mi.Ray3f,
    pi: mi.PreliminaryIntersection3f,
    active: mi.Bool,
    flags: mi.RayFlags = mi.RayFlags.Minimal,
) -> mi.SurfaceInteraction3f:
    """What a ray meets; it follows its surface, attached unless gradients are suspended. Of instances, only points are
    attached: `surface_met` has all."""
    return pi.compute_surface_interaction(ray, flags | mi.RayFlags.FollowShape, active)


def sliding_point(
    scene: mi.Scene, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, held: mi.Float, active: mi.Bool
) -> mi.SurfaceInteraction3f:
    """What a ray meets, attached to the surface and to the ray: the part `held` of its motion is that of the material
    point, the rest that of the point where the ray meets the surface."""
    si = surface_met(scene, dr.detach(ray), pi, FOLLOWS, active)
    slides = active & (dr.detach(held) < 1)
    # A ray from its own plane meets it anywhere, as far as rounding can tell, and would slide arbitrarily fast.
    slides &= ~grazes(si, ray.d, slides) & ~in_plane(si, dr.detach(ray.o))
    slid = surface_met(scene, ray, pi, mi.RayFlags.All, slides)

    def blend(a, b):
        if not dr.grad_enabled(a, b):
            return a
        return dr.select(slides, dr.replace_grad(a, dr.lerp(b, a, held)), a)

    for field in ("p", "n", "uv", "dp_du", "dp_dv", "dn_du", "dn_dv"):
        setattr(si, field, blend(getattr(si, field), getattr(slid, field)))
    frame = si.sh_frame
    si.sh_frame = mi.Frame3f(*(blend(getattr(frame, k), getattr(slid.sh_frame, k)) for k in "stn"))
    return si


def shown_by_mirror(
    scene: mi.Scene,
    si: mi.SurfaceInteraction3f,
    wo: mi.Vector3f,
    ray: mi.Ray3f,
    pi: mi.PreliminaryIntersection3f,
    active: mi.Bool,
) -> mi.SurfaceInteraction3f:
    """The surface that a ray meets which leaves `si` in the direction `wo` of its frame, both attached: what a mirror
    shows slides over the surface."""
    turned = mi.Ray3f(ray)
    turned.o, turned.d = si.p, si.to_world(wo)
    return surface_met(scene, turned, pi, mi.RayFlags.All, active)


def look_from(si: mi.SurfaceInteraction3f, x: mi.Point3f, ray: mi.Ray3f, t: mi.Float) -> None:
    """Attach the direction in which a surface is looked at to the point x that looks, along a ray of the length t.

    Only the motion across the ray turns it. That is projected out, rather than found from the normalised difference of
    both points: where they are close to each other, rounding turns this difference, and of a motion along the ray, by
    which points slide away from each other, a part would seem to go across it.
    """
    d, between = dr.detach(ray.d), si.p - x
    across = between - d * dr.dot(d, between)
    turn = (across - dr.detach(across)) / dr.select(t > 0, t, 1)
    si.wi = dr.replace_grad(si.wi, si.to_local(-(d + turn)))


def grazes(si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Bool:
    """Is a curved surface met almost along a tangent?"""
    return active & si.is_valid() & ~si.shape.is_mesh() & (dr.abs_dot(dr.detach(si.n), dr.detach(direction)) < GRAZING)


def flush(x: mi.SurfaceInteraction3f, y: mi.SurfaceInteraction3f) -> mi.Bool:
    """Does y lie in the tangent plane at x, or x in that at y, as far as single precision can tell?

    So do points of one face, and points close to each other on one curved surface: one does not light the other, but
    the cosine between them is what rounding makes it, and its derivative relative to that is arbitrarily large.
    """
    return in_plane(x, y.p) | in_plane(y, x.p)


def in_plane(x: mi.SurfaceInteraction3f, p: mi.Point3f, slack: mi.Float | float = 0.0) -> mi.Bool:
    """Does a point lie in the tangent plane at x, as far as single precision can tell? slack : how far off, besides."""
    with dr.suspend_grad():
        scale = dr.max(dr.maximum(dr.abs(x.p), dr.abs(p)))
        return dr.abs_dot(x.n, p - x.p) <= FLUSH * dr.epsilon(mi.Float) * scale + slack


# ---------------------- Vicinity ----------------------


class Slides(Enum):
    """What else slides than what is close to the vertex before: nothing; what rough glass shows; everything. (Where the
    values of a grid change, its points move across its surface only, and in another way on each side of a crease: of
    all points that are held, these alone are not to be told.)"""

    NOTHING = 0
    BEHIND_GLASS = 1
    EVERYTHING = 2


@dataclass(frozen=True)
class Vicinity:
    """The ball around each vertex of a path in which the next one slides.

    radius : mi.Float, (N,), scene units; detached. 0: nothing slides; infinite: everything does.
    glass : is that of rough glass infinite? See `slides_behind_glass`.
    """

    radius: mi.Float
    glass: bool = False

    @staticmethod
    def of(first: mi.PreliminaryIntersection3f, slides: Slides = Slides.NOTHING) -> Vicinity:
        """That of the paths which meet their first vertex there."""
        radius = mi.Float(dr.inf) if slides is Slides.EVERYTHING else VICINITY * first.t
        return Vicinity(dr.select(first.is_valid(), radius, 0), slides is Slides.BEHIND_GLASS)

    def around(self, bsdf: mi.BSDFPtr) -> Vicinity:
        """That of a vertex on a surface with this BSDF."""
        return Vicinity(dr.select(self.is_infinite(bsdf), dr.inf, self.radius)) if self.glass else self

    def is_infinite(self, bsdf: mi.BSDFPtr) -> mi.Bool:
        """Does everything slide that a surface with this BSDF shows?"""
        if not self.glass:
            return mi.Bool(False)
        flags = bsdf.flags()
        rough = mi.has_flag(flags, mi.BSDFFlags.GlossyTransmission) & ~mi.has_flag(flags, mi.BSDFFlags.Diffuse)
        return rough & (self.radius > 0)

    def far(self, r2: mi.Float) -> mi.Float:
        """Part of the light from the squared distance `r2` that is held at the material point: 1 from the radius on,
        and in proportion to r2 near 0. It may be attached."""
        s = dr.select(self.radius > 0, r2 / dr.square(dr.maximum(self.radius, 1e-18)), 1)
        return _blend(s)


def _blend(s: mi.Float) -> mi.Float:
    """From 0 to 1 where s does, smooth at 1."""
    rest = 1 - dr.minimum(s, 1)
    return 1 - rest * dr.square(rest)


def slides_behind_glass(scene: mi.Scene, shaded: list[mi.Shape]) -> bool:
    """May all that rough glass shows slide? There must be some, and no face that other normals than its own shade.

    shaded : the shapes with such faces.
    """
    bsdfs = [s.bsdf() for s in scene.shapes()]
    if shaded or None in bsdfs:
        return False
    return any(b.flags() & mi.BSDFFlags.GlossyTransmission for b in bsdfs)


# ---------------------- Lobes ----------------------


@dataclass
class Turning:
    """The narrow lobe of a BSDF as a viewer sees it, with which directions turn.

    axis : mi.Vector3f, unit vector, world space; may be attached.
    width : mi.Float, radians; detached; 0 where there is no narrow lobe.
    size : mi.Float, of what sends light; infinite, if that is infinitely far away; 0: nothing turns.
    """

    axis: mi.Vector3f
    width: mi.Float
    size: mi.Float

    @property
    def anywhere(self) -> mi.Bool:
        """Does anything turn?"""
        return (self.width > 0) & (self.size > 0)

    def part(self, ω: mi.Vector3f, r2: mi.Float | None = None) -> mi.Float:
        """Part of the light from a direction, and a squared distance, whose direction turns: 1 on the axis of a lobe
        that is much narrower than what sends it. It may be attached. r2 : None: from infinitely far away."""
        active = self.anywhere
        width = dr.select(active, self.width, 1)
        part = 1 - _blend(dr.squared_norm(ω - self.axis) / dr.square(REACH * width))
        if r2 is None:
            return dr.select(active & (self.size == dr.inf), part, 0)
        part *= 1 - _blend(r2 * dr.square(WIDE * width / dr.select(active, self.size, 1)))
        return dr.select(active, part, 0)

    def turned(self, d: mi.Vector3f) -> mi.Vector3f:
        """The direction d, as it turns with the axis: without turning about that."""
        d = dr.detach(d)
        turns = dr.cross(dr.cross(dr.detach(self.axis), self.axis), d)
        return dr.replace_grad(d, dr.select(self.anywhere, turns, 0))


@dataclass
class Division:
    """How the light that arrives at a point is divided: a part is held at the material point from where it comes, the
    rest in its direction.

    turning : with which directions turn; None: they do not.
    """

    vicinity: Vicinity
    turning: Turning | None = None

    def held(self, r2: mi.Float, ω: mi.Vector3f) -> mi.Float:
        """Part of the light from the squared distance `r2` and the direction ω that is held at the material point. It
        may be attached."""
        far = self.vicinity.far(r2)
        return far if self.turning is None else far * (1 - self.turning.part(ω, r2))

    def held_at_infinity(self, ω: mi.Vector3f) -> mi.Float:
        """The same, from infinitely far away: there, it is the part of which directions do not turn."""
        return mi.Float(1) if self.turning is None else 1 - self.turning.part(ω)

    def turns(self, r2: mi.Float, ω: mi.Vector3f) -> mi.Float:
        """Part of it whose direction turns with a lobe."""
        return mi.Float(0) if self.turning is None else self.turning.part(ω, r2)

    def held_beside(self, d: mi.Vector3f, ω: mi.Vector3f, valid: mi.Bool) -> mi.Float:
        """Part that is held of what a ray past an edge, in the direction ω, meets at the place d; or infinitely far
        away, if it meets nothing. Detached."""
        held = dr.select(valid, self.held(dr.squared_norm(d), ω), self.held_at_infinity(ω))
        return dr.detach(held)

    def turned(self, d: mi.Vector3f) -> mi.Vector3f:
        """The direction d as it is held."""
        return dr.detach(d) if self.turning is None else self.turning.turned(d)

    def at_infinity(self, d: mi.Vector3f) -> tuple[mi.Vector3f, mi.Float]:
        """The direction d to what is infinitely far away, attached; and the change of both parts, as `Connection` has
        it."""
        if self.turning is None:
            return d, mi.Float(1)
        d = dr.detach(d)
        held = self.held_at_infinity(d)
        now = dr.detach(held)
        return dr.replace_grad(d, dr.lerp(self.turned(d), d, now)), 1 + held - now


# ---------------------- What joins two of them ----------------------


@dataclass
class Connection:
    """What joins a point to a material point y that a ray from there meets. Attached.

    y : mi.SurfaceInteraction3f.
    ω : mi.Vector3f, the direction to it.
    geometry : mi.Float, |cos θ_y| dA / r², relative to its present value.
    still : mi.Bool, is all of this taken to stand still, since rounding would make its derivative? Then it is detached.
    smooth : mi.Bool, is y on one of the `SmoothLamps`, and does not stand still?
    spread : mi.Float, if so: the solid angle of an element of area there, as light samples reckon it, relative to its
        present value.
    """

    y: mi.SurfaceInteraction3f
    ω: mi.Vector3f
    geometry: mi.Float
    still: mi.Bool
    smooth: mi.Bool
    spread: mi.Float

    def sliding(self, x: mi.SurfaceInteraction3f, d: mi.Vector3f, division: Division, active: mi.Bool) -> Connection:
        """The same where y slides, seen from x: a part is held at the material point, the rest in its direction d, and
        both follow the change of this part along their own motion. Only ω and `geometry` are those of y as it slides.
        """
        between, n, d = self.y.p - x.p, dr.detach(self.y.n), dr.detach(d)
        held = division.held(dr.detach(dr.squared_norm(between)), d)
        held = dr.detach(held)
        turned = division.turned(d)
        active = active & ~self.still & (dr.dot(d, n) != 0) & (held < 1)
        # Along the ray, to the plane that moves with y.
        along = dr.dot(between, n) / dr.select(active, dr.dot(turned, n), 1)
        rest = 1 - division.held(dr.square(along), turned)
        geometry = held * self.geometry + division.held(dr.squared_norm(between), self.ω) + rest
        geometry = dr.replace_grad(self.geometry, dr.select(active, geometry, self.geometry))
        ω = dr.replace_grad(self.ω, dr.select(active, dr.lerp(turned, self.ω, held), self.ω))
        return replace(self, ω=ω, geometry=geometry, smooth=self.smooth & (held == 1))

    def attach(self, weight: mi.Float, p: mi.Float, q: mi.Float, *, by_light: bool) -> mi.Float:
        """Attach a weight of multiple importance sampling where y is on one of the `SmoothLamps`.

        p, q : the densities of which it is made, that of light samples detached. by_light : is that p, or q?
        """
        attached = self.smooth & (self.spread > 0) & (p > 0) & dr.isfinite(p) & dr.isfinite(q)
        spread = dr.select(attached, self.spread, 1)
        ratio = dr.select(attached, q, 0) / dr.select(attached, p, 1) * (spread if by_light else dr.rcp(spread))
        return dr.select(attached, dr.replace_grad(weight, dr.rcp(1 + dr.square(ratio))), weight)


class Parametrisation:
    """What the samples of a scene hold fixed, where they are not single points.

    scene : mi.Scene, whose parameters carry their gradients already.
    """

    def __init__(self, scene: mi.Scene):
        self.scene = scene
        moving = [s for s in scene.shapes() if s.parameters_grad_enabled()]
        self.moving = [
            (mi.ShapePtr(s), s.is_mesh() or s.class_name() == "Instance") for s in moving if s.class_name() != "SDFGrid"
        ]
        #: Grids, whose parametrisation has no derivatives in Mitsuba.
        self.grids = [s for s in moving if s.class_name() == "SDFGrid"]
        self.any_curved = any(not s.is_mesh() for s in scene.shapes())
        self.smooth_lamps = SmoothLamps(scene)

    def connect(self, si, pi, ray, active, *, by_light: bool) -> Connection:
        """What joins `si` to the material point that `pi` stands for, found by a sample of a light or of the BSDF."""
        y = surface_met(self.scene, ray, pi, FOLLOWS, active)
        d = y.p - si.p
        r2 = dr.squared_norm(d)
        ω = d * dr.rsqrt(r2)
        # A ray that meets nothing keeps its direction.
        y.wi = dr.select(active, dr.replace_grad(y.wi, y.to_local(-ω)), y.wi)
        cos, smooth, spread = dr.abs_dot(y.n, ω), mi.Bool(False), mi.Float(1)
        if len(self.smooth_lamps):
            smooth, shading_cos = self.smooth_lamps.are(pi.shape), dr.abs_dot(y.sh_frame.n, ω)
            spread = _relative(shading_cos / r2)  # 0 only where nothing is emitted
            if by_light:
                cos = dr.select(smooth, shading_cos, cos)
        geometry = cos / r2
        geometry *= self.area(pi, ray, y, active)
        geometry = _relative(geometry)
        still = active & flush(si, y)
        fixed = still | grazes(y, ω, active) if self.any_curved else still
        y, ω = dr.select(still, dr.detach(y), y), dr.select(still, dr.detach(ω), ω)
        return Connection(y, ω, dr.select(fixed, dr.detach(geometry), geometry), still, smooth & ~still, spread)

    def area(self, pi, ray, y, active) -> mi.Float:
        """What an area element at y, which `pi` stands for, is proportional to, attached; 1 where nothing moves."""
        area = mi.Float(1)
        for shape in self.grids:
            area *= _area_of_grid(shape, pi, y, active)
        if not self.moving:
            return area
        on_mesh, on_other = mi.Bool(False), mi.Bool(False)
        for shape, is_mesh in self.moving:
            met = (pi.shape == shape) | (pi.instance == shape)
            on_mesh |= is_mesh & met
            on_other |= (not is_mesh) & met
        on_mesh, on_other = on_mesh & active, on_other & active
        # Of a triangle, twice its area.
        corners = []
        for u, v in ((0, 0), (1, 0), (0, 1)):
            corner = mi.PreliminaryIntersection3f(pi)
            corner.prim_uv = mi.Point2f(u, v)
            corners.append(material_point(ray, corner, on_mesh).p)
        of_mesh = dr.norm(dr.cross(corners[1] - corners[0], corners[2] - corners[0]))
        area = dr.select(on_mesh, of_mesh, area)
        if all(is_mesh for _, is_mesh in self.moving):
            return area
        si = material_point(ray, pi, on_other, mi.RayFlags.dPdUV)
        return dr.select(on_other, dr.norm(dr.cross(si.dp_du, si.dp_dv)), area)


def _area_of_grid(shape: mi.Shape, pi: mi.PreliminaryIntersection3f, y: mi.SurfaceInteraction3f, active) -> mi.Float:
    """What an area element at y on a grid is proportional to, attached to `to_world`; 1 where y is on another shape."""
    to_world = mi.traverse(shape)["to_world"]
    to_local = dr.detach(to_world).inverse()
    u, v = (to_world @ (to_local @ w) for w in mi.coordinate_system(dr.detach(y.n)))
    return dr.select(active & (pi.shape == mi.ShapePtr(shape)), dr.norm(dr.cross(u, v)), 1)


def _relative(x: mi.Float) -> mi.Float:
    """A number over its present value; 0 where that is 0."""
    now = dr.detach(x)
    return dr.select(now > 0, x / dr.select(now > 0, now, 1), 0)
