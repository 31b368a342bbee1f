"""From world space to the film: the one place that knows the sensors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.refusals import Refusal

#: Class names of the sensors that `Projection` knows, by plugin name.
SENSORS = {
    "perspective": "PerspectiveCamera",
    "thinlens": "ThinLensCamera",
    "orthographic": "OrthographicCamera",
    "fisheye": "FisheyeSensor",
}

#: By how much the cones are widened to which edges are clipped, in radians: what lies outside of the frame counts for
#: nothing anyway, and rounding must not take away what lies inside.
MARGIN = 1e-3


@dataclass(frozen=True)
class FilmPoint:
    """A point in homogeneous film coordinates: linear in the world position where the sensor keeps lines straight, so
    that edges can be clipped in them.

    xy : mi.Point2f, film position in pixels times `w` (the origin of the whole film, not of the crop window).
    w  : mi.Float, depth along the optical axis (perspective) or 1 (orthographic, fisheye).
    z  : mi.Float, what the clipping planes are compared with, scene units: depth along the optical axis, or distance
        (fisheye).
    """

    xy: mi.Point2f
    w: mi.Float
    z: mi.Float

    def position(self) -> mi.Point2f:
        return self.xy / self.w


class Part(ABC):
    """The part of an edge that may be visible, as an interval of which the fractions s in [0, 1] are sampled.

    length : mi.Float, approximate length on the film, pixels; 0 where nothing is visible.
    """

    length: mi.Float

    @abstractmethod
    def parameter(self, s: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Edge parameter t at a fraction s of the part, and dt/ds."""


class Projection(ABC):
    """The projection of a sensor as it stands, attached to every parameter of the sensor that carries a gradient.

    It inverts `Sensor.sample_ray`: `film(ray(t), aperture_sample).position()` is the film position that the ray was
    made for.

    Parameters
    ----------
    sensor : mi.Sensor, one of `SENSORS`. Its type decides which subclass the instance is of.

    Raises
    ------
    RuntimeError : the sensor is of another type.
    """

    orthographic = False
    aperture_radius: mi.Float | None = None

    def __new__(cls, sensor: mi.Sensor):
        kind = _kind(sensor)
        if kind not in SENSORS.values():
            raise Refusal(
                f'film boundary: sensor "{sensor.id()}" ({kind}) is not supported, use one of {", ".join(SENSORS)}, '
                "or a batch of them"
            )
        return super().__new__(FisheyeProjection if kind == SENSORS["fisheye"] else PlanarProjection)

    def __init__(self, sensor: mi.Sensor):
        film = sensor.film()
        self.crop_offset = mi.ScalarVector2f(film.crop_offset())
        self.crop_size = mi.ScalarVector2f(film.crop_size())
        self.frame = frame(film)
        self.to_world = sensor.world_transform()
        self.to_local = self.to_world.inverse()

    @abstractmethod
    def film(self, p: mi.Point3f, aperture_sample: mi.Point2f | None = None) -> FilmPoint:
        """Project a point through the centre of the lens, or through the point of the lens that `aperture_sample`
        stands for.

        p : mi.Point3f, (N,), world space, scene units.
        """

    @abstractmethod
    def tangent(
        self, a: mi.Point3f, b: mi.Point3f, t: mi.Float, aperture_sample: mi.Point2f | None = None
    ) -> mi.Vector2f:
        """du/dt along the edge from a to b, in pixels."""

    @abstractmethod
    def clip(self, a: mi.Point3f, b: mi.Point3f) -> Part:
        """What is visible of the edge from a to b: all that is in the frame, and possibly more. Detached."""

    @abstractmethod
    def pixels_per_area(self, p: mi.Point3f, d: mi.Vector3f) -> mi.Float:
        """Area on the film, in pixels, of a small surface at p, over its area across the line of sight: mi.Float, (N,).
        Detached.

        d : mi.Vector3f, (N,), unit length, from p towards the point of the lens that sees it.
        """

    @abstractmethod
    def distance(self, p: mi.Point3f, d: mi.Vector3f) -> mi.Float:
        """From p along d to where the sensor's ray to it starts: mi.Float, (N,), scene units, negative where none can
        reach it. Detached."""

    @abstractmethod
    def pixels_per_unit(self, point: FilmPoint) -> mi.Float:
        """How many pixels a short length across the line of sight covers. Detached."""

    def eye(self, aperture_sample: mi.Point2f | None = None) -> mi.Point3f:
        """Centre of the lens, or the point of it that `aperture_sample` stands for: world space. Detached."""
        lens = mi.Point2f(0)
        if aperture_sample is not None:
            lens = mi.warp.square_to_uniform_disk_concentric(aperture_sample) * self.lens_radius()
        return dr.detach(self.to_world) @ mi.Point3f(lens.x, lens.y, 0)

    def viewer(self, aperture_sample: mi.Point2f | None = None) -> mi.Point3f:
        """Point of the lens as `eye` has it, or where rays are parallel the direction towards the viewer: world space;
        attached, if gradients are not suspended."""
        if self.orthographic:
            return mi.Point3f(dr.normalize(self.to_world @ mi.Vector3f(0, 0, -1)))
        lens = mi.Point2f(0)
        if aperture_sample is not None and self.aperture_radius is not None:
            lens = mi.warp.square_to_uniform_disk_concentric(aperture_sample) * self.aperture_radius
        return self.to_world @ mi.Point3f(lens.x, lens.y, 0)

    def view(self) -> mi.Vector3f:
        """Optical axis, world space, unit length. Detached."""
        return dr.normalize(dr.detach(self.to_world) @ mi.Vector3f(0, 0, 1))

    def lens_radius(self) -> mi.Float:
        """Radius of the lens, 0 for a pinhole. Detached."""
        return mi.Float(0)

    def blur(self, point: FilmPoint) -> mi.Float:
        """Largest displacement on the film, times `point.w`, that another point of the lens than its centre makes, in
        pixels. Detached."""
        return mi.Float(0)


class PlanarProjection(Projection):
    """`perspective`, `thinlens`, `orthographic`: lines stay straight, since homogeneous film coordinates are affine in
    the point."""

    def __init__(self, sensor: mi.Sensor):
        super().__init__(sensor)
        kind, params = _kind(sensor), mi.traverse(sensor)
        self.orthographic = kind == SENSORS["orthographic"]
        self.to_sample = sensor.projection_transform().matrix
        # The offsets are relative to the whole film, the sample space to the crop window (as in Mitsuba's
        # `perspective`).
        self.principal_point = mi.Vector2f(0)
        if "principal_point_offset_x" in params:
            offset = mi.Vector2f(params["principal_point_offset_x"], params["principal_point_offset_y"])
            self.principal_point = offset * mi.ScalarVector2f(sensor.film().size()) / self.crop_size
        self.aperture_radius = params["aperture_radius"] if kind == SENSORS["thinlens"] else None
        self.focus_distance = sensor.focus_distance()
        self.near, self.far = sensor.near_clip(), sensor.far_clip()
        # Pixels per unit across the line of sight, at a depth of 1. Detached. An orthographic sensor is as large as its
        # transformation makes it, across but not along the view.
        to_sample, to_local = dr.detach(self.to_sample), dr.detach(self.to_local).matrix
        rows = [dr.norm(mi.Vector3f([to_local[i, k] for k in range(3)])) if self.orthographic else 1 for i in (0, 1)]
        self.scales = [dr.abs(to_sample[i, i]) * self.crop_size[i] * rows[i] for i in (0, 1)]
        self.attached = dr.grad_enabled(
            self.to_world, self.to_sample, self.principal_point, self.aperture_radius, self.focus_distance
        )  # fmt: skip

    def film(self, p: mi.Point3f, aperture_sample: mi.Point2f | None = None) -> FilmPoint:
        q = self.to_local @ p
        xyz, w = mi.Vector3f(q), mi.Float(1)
        if aperture_sample is not None and self.aperture_radius is not None:
            # The line from the lens through q meets the plane in focus at lens + (q - lens) f / q.z. Times q.z, this
            # is linear in q.
            lens = mi.warp.square_to_uniform_disk_concentric(aperture_sample) * self.aperture_radius
            f = self.focus_distance
            xyz, w = mi.Vector3f(lens.x * (q.z - f) + f * q.x, lens.y * (q.z - f) + f * q.y, f * q.z), q.z
        h = self.to_sample @ mi.Vector4f(xyz.x, xyz.y, xyz.z, w)
        sample = mi.Vector2f(h.x, h.y) - self.principal_point * h.w
        return FilmPoint(mi.Point2f(sample * self.crop_size + self.crop_offset * h.w), h.w, q.z)

    def tangent(
        self, a: mi.Point3f, b: mi.Point3f, t: mi.Float, aperture_sample: mi.Point2f | None = None
    ) -> mi.Vector2f:
        # Derivative of a quotient of two linear functions.
        p, q = self.film(a, aperture_sample), self.film(b, aperture_sample)
        w = dr.lerp(p.w, q.w, t)
        u = dr.lerp(p.xy, q.xy, t) / w
        return mi.Vector2f((q.xy - p.xy) - u * (q.w - p.w)) / w

    def clip(self, a: mi.Point3f, b: mi.Point3f) -> Segment:
        """To near and far planes and to the frame plus the blur of the lens (Liang and Barsky 1984)."""
        a, b = self.film(a), self.film(b)
        lower, upper = self.frame
        blur_a, blur_b = self.blur(a), self.blur(b)
        start, end = mi.Float(0), mi.Float(1)
        near, far = self.near * (1 - 1e-4), self.far  # cuts lie on the near plane, but for rounding
        planes = [(a.z - near, b.z - near), (far - a.z, far - b.z)]
        for i in (0, 1):
            planes.append((a.xy[i] - lower[i] * a.w + blur_a, b.xy[i] - lower[i] * b.w + blur_b))
            planes.append((upper[i] * a.w - a.xy[i] + blur_a, upper[i] * b.w - b.xy[i] + blur_b))
        for at_a, at_b in planes:
            crossing = at_a / (at_a - at_b)
            start = dr.select(at_a < 0, dr.select(at_b < 0, 1, dr.maximum(start, crossing)), start)
            end = dr.select(at_b < 0, dr.select(at_a < 0, 0, dr.minimum(end, crossing)), end)
        at = lambda t: FilmPoint(dr.lerp(a.xy, b.xy, t), dr.lerp(a.w, b.w, t), dr.lerp(a.z, b.z, t))
        p, q = at(start), at(end)
        length = dr.select(start < end, dr.norm(q.position() - p.position()), 0)
        return Segment(start, end, p.w, q.w, _visible(length))

    def lens_radius(self) -> mi.Float:
        return mi.Float(0) if self.aperture_radius is None else dr.detach(mi.Float(self.aperture_radius))

    def blur(self, point: FilmPoint) -> mi.Float:
        if self.aperture_radius is None:
            return mi.Float(0)
        scale = dr.abs(dr.detach(self.to_sample)[0, 0]) * self.crop_size.x
        return scale * self.lens_radius() * dr.abs(point.z / dr.detach(self.focus_distance) - 1)

    def pixels_per_area(self, p: mi.Point3f, d: mi.Vector3f) -> mi.Float:
        x, y = self.scales
        if self.orthographic:
            return x * y
        # Those of a plane at depth 1, at distance r under the angle θ: cos θ / r² · 1 / cos⁴ θ, with depth r cos θ. See
        # `importance` of Mitsuba's `perspective`.
        return x * y / (dr.square(self._depth(p)) * self._cosine(d))

    def distance(self, p: mi.Point3f, d: mi.Vector3f) -> mi.Float:
        # Planes are in units of an orthographic sensor, which its transformation may stretch; rays end in the world's.
        row = mi.Vector3f([dr.detach(self.to_local).matrix[2, k] for k in range(3)])
        beyond_near = (self._depth(p) - self.near) / dr.norm(row)
        return dr.select(beyond_near > self.far - self.near, -1, beyond_near / self._cosine(d))

    def _depth(self, p: mi.Point3f) -> mi.Float:
        return (dr.detach(self.to_local) @ p).z

    def _cosine(self, d: mi.Vector3f) -> mi.Float:
        """Of the angle between a line of sight and the optical axis."""
        return dr.maximum(-dr.dot(d, self.view()), 1e-6)

    def pixels_per_unit(self, point: FilmPoint) -> mi.Float:
        return dr.maximum(*self.scales) / dr.abs(point.w)


@dataclass(frozen=True)
class Segment(Part):
    """Part of a line on the film: interval of the edge's parameter, depths at its ends, and exact length. Fractions are
    those of the length on the film."""

    start: mi.Float
    end: mi.Float
    w_start: mi.Float
    w_end: mi.Float
    length: mi.Float

    def parameter(self, s: mi.Float) -> tuple[mi.Float, mi.Float]:
        d = dr.lerp(self.w_end, self.w_start, s)
        extent = self.end - self.start
        return self.start + extent * s * self.w_start / d, extent * self.w_start * self.w_end / dr.square(d)


class FisheyeProjection(Projection):
    """`fisheye`: lines become curves. Edges are arcs of great circles on the sphere of directions."""

    def __init__(self, sensor: mi.Sensor):
        super().__init__(sensor)
        self.near, self.far = 0.0, dr.inf
        self.centre = 0.5 * mi.ScalarVector2f(sensor.film().size())
        self.radius = sensor.circle_radius()
        self.scale = sensor.pixels_per_radian()
        self.attached = dr.grad_enabled(self.to_world, self.scale)

    def film(self, p: mi.Point3f, aperture_sample: mi.Point2f | None = None) -> FilmPoint:
        q = mi.Vector3f(self.to_local @ p)
        return FilmPoint(mi.Point2f(self.scale * equidistant(q) + self.centre), mi.Float(1), dr.norm(q))

    def tangent(
        self, a: mi.Point3f, b: mi.Point3f, t: mi.Float, aperture_sample: mi.Point2f | None = None
    ) -> mi.Vector2f:
        # Derivative of θ (x, y) / ρ, with ρ = |(x, y)|, θ = atan2(ρ, z) and the radial and the angular part apart.
        q, v = self.to_local @ dr.lerp(a, b, t), self.to_local @ mi.Vector3f(b - a)
        xy, v_xy = mi.Vector2f(q.x, q.y), mi.Vector2f(v.x, v.y)
        ρ = dr.sqrt(dr.maximum(dr.squared_norm(xy), 1e-30))
        radial = xy / ρ
        ρ_t = dr.dot(radial, v_xy)
        θ, θ_t = dr.atan2(ρ, q.z), (q.z * ρ_t - ρ * v.z) / dr.squared_norm(q)
        return -self.scale * (θ_t * radial + θ / ρ * (v_xy - ρ_t * radial))

    def clip(self, a: mi.Point3f, b: mi.Point3f) -> Arc:
        """To the image circle and to a circle around the frame, as cones around the eye, where they are not wider than
        half of the sphere."""
        to_local, scale = dr.detach(self.to_local), dr.detach(self.scale)
        a, b = mi.Vector3f(to_local @ a), mi.Vector3f(to_local @ b)
        arc = Arc.between(a, b, scale)
        arc = arc.clipped(mi.Vector3f(0, 0, 1), self.radius / scale)
        # No angle is smaller on the film than along a radius: so the cone holds all of the frame.
        lower, upper = map(mi.ScalarVector2f, self.frame)
        middle = from_equidistant((0.5 * (lower + upper) - self.centre) / scale)
        return arc.clipped(middle, 0.5 * dr.norm(upper - lower) / scale)

    def pixels_per_area(self, p: mi.Point3f, d: mi.Vector3f) -> mi.Float:
        # θ dθ dφ on the film for sin θ dθ dφ.
        q = mi.Vector3f(dr.detach(self.to_local) @ p)
        θ = dr.maximum(dr.norm(equidistant(q)), 1e-6)
        inside = θ * dr.detach(self.scale) <= self.radius
        density = dr.square(dr.detach(self.scale)) * (θ / dr.sin(θ)) / dr.squared_norm(q)
        return dr.select(inside, density, 0)

    def distance(self, p: mi.Point3f, d: mi.Vector3f) -> mi.Float:
        return dr.norm(mi.Vector3f(dr.detach(self.to_local) @ p))

    def pixels_per_unit(self, point: FilmPoint) -> mi.Float:
        scale = dr.detach(self.scale)
        θ = dr.norm(point.position() - self.centre) / scale
        # Behind the camera, a point is stretched to a circle.
        return scale * dr.maximum(1, θ / dr.maximum(dr.sin(θ), 1e-3)) / point.z


@dataclass(frozen=True)
class Arc(Part):
    """Part of an edge, as an interval of the angle that the eye turns by from its first end point. Fractions are those
    of the angle, which is the length on the film along a radius, and less than it across.

    towards, across : mi.Vector3f, unit vectors: to the first end point, and at right angles, to the side of the second.
    distances : of the end points from the eye.
    angle : between the end points, radians.
    start, end : of the interval, radians.
    scale : pixels per radian.
    """

    towards: mi.Vector3f
    across: mi.Vector3f
    distances: tuple[mi.Float, mi.Float]
    angle: mi.Float
    start: mi.Float
    end: mi.Float
    scale: mi.Float

    @staticmethod
    def between(a: mi.Vector3f, b: mi.Vector3f, scale: mi.Float) -> Arc:
        """a, b : end points, from the eye."""
        towards = dr.normalize(a)
        normal = dr.cross(towards, b - a)
        angle = dr.atan2(dr.norm(normal), dr.dot(towards, b))
        across = dr.cross(dr.normalize(normal), towards)
        return Arc(towards, across, (dr.norm(a), dr.norm(b)), angle, mi.Float(0), angle, scale)

    @property
    def length(self) -> mi.Float:
        return _visible((self.end - self.start) * self.scale)

    def clipped(self, axis: mi.Vector3f, radius: mi.Float) -> Arc:
        """The part in a cone about `axis` (unit length) of half-angle `radius`, and in front of a plane at the most. Of
        wider cones, all or nothing: what is outside of them is convex."""
        # Along the arc, the cosine to the axis is p cos ψ + q sin ψ = m cos(ψ - middle).
        p, q = dr.dot(self.towards, axis), dr.dot(self.across, axis)
        middle = dr.atan2(q, p)
        middle += dr.select(middle < 0.5 * self.angle - dr.pi, dr.two_pi, 0)
        radius = dr.minimum(radius + MARGIN, dr.pi)
        wide = radius > 0.5 * dr.pi
        limit = dr.cos(radius)
        half = dr.acos(dr.clip(limit / dr.hypot(p, q), -1, 1))
        seen = (p >= limit) | (dr.fma(p, dr.cos(self.angle), q * dr.sin(self.angle)) >= limit)
        start = dr.select(wide, self.start, dr.maximum(self.start, middle - half))
        end = dr.select(wide, dr.select(seen, self.end, self.start), dr.minimum(self.end, middle + half))
        return replace(self, start=start, end=end)

    def parameter(self, s: mi.Float) -> tuple[mi.Float, mi.Float]:
        # Along the edge, t |b| : (1 - t) |a| = sin ψ : sin(angle - ψ).
        ψ = dr.lerp(self.start, self.end, s)
        a, b = self.distances
        from_a, from_b = a * dr.sin(ψ), b * dr.sin(self.angle - ψ)
        extent = self.end - self.start
        total = from_a + from_b
        return from_a / total, extent * a * b * dr.sin(self.angle) / dr.square(total)


def equidistant(d: mi.Vector3f) -> mi.Vector2f:
    """A direction, local to a fisheye camera, as a vector on the film whose length is the angle from the optical axis:
    mi.Vector2f, (N,), radians.

    d : mi.Vector3f, (N,), of any length.
    """
    ρ = dr.sqrt(dr.maximum(dr.square(d.x) + dr.square(d.y), 1e-30))  # on the axis, the root has no derivative
    return mi.Vector2f(-d.x, -d.y) * (dr.atan2(ρ, d.z) / ρ)


def from_equidistant(angle: mi.Vector2f) -> mi.Vector3f:
    """The inverse of `equidistant`: mi.Vector3f, (N,), unit length."""
    θ = dr.sqrt(dr.maximum(dr.squared_norm(angle), 1e-12))  # at the centre, the root has no derivative
    sinc = dr.sin(θ) / θ
    return mi.Vector3f(-sinc * angle.x, -sinc * angle.y, dr.cos(θ))


def sampled_border(film: mi.Film) -> int:
    """How wide the border is that is sampled around the film, in pixels. A box filter has none."""
    return film.rfilter().border_size() if film.sample_border() else 0


def frame(film: mi.Film) -> tuple[mi.ScalarPoint2f, mi.ScalarPoint2f]:
    """The part of the film that is sampled, in pixels: the crop window, and the border if the film asks for it."""
    border = sampled_border(film)
    lower = mi.ScalarPoint2f(film.crop_offset()) - border
    return lower, lower + mi.ScalarVector2f(film.crop_size()) + 2 * border


def inside_frame(u: mi.Point2f, film: mi.Film) -> mi.Bool:
    lower, upper = frame(film)
    return dr.all((u >= lower) & (u < upper))


def tangent(
    projection: Projection, a: mi.Point3f, b: mi.Point3f, t: mi.Float, aperture_sample: mi.Point2f | None
) -> mi.Vector2f:
    """`Projection.tangent`."""
    return projection.tangent(a, b, t, aperture_sample)


def _kind(sensor: mi.Sensor) -> str:
    """Name of the class. Mitsuba knows sensors that are written in Python by that of their base."""
    return sensor.class_name() if sensor.class_name() != "Sensor" else type(sensor).__name__


def _visible(length: mi.Float) -> mi.Float:
    """Written so that NaN, as from vertices that are not finite, counts as invisible."""
    return dr.select((length > 0) & dr.isfinite(length), length, 0)
