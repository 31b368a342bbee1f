"""From world space to the film: the one place that knows the sensors."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: Mitsuba's class names of the sensors that `Projection` knows, by plugin name.
SENSORS = {"perspective": "PerspectiveCamera", "thinlens": "ThinLensCamera", "orthographic": "OrthographicCamera"}


@dataclass(frozen=True)
class FilmPoint:
    """A point in homogeneous film coordinates: linear in the world position, so that edges can be clipped in them.

    xy : mi.Point2f, film position in pixels times `w` (the origin of the whole film, not of the crop window).
    w  : mi.Float, depth along the optical axis (perspective) or 1 (orthographic).
    z  : mi.Float, depth along the optical axis, scene units.
    """

    xy: mi.Point2f
    w: mi.Float
    z: mi.Float

    def position(self) -> mi.Point2f:
        return self.xy / self.w


class Projection:
    """The projection of a sensor as it stands, attached to every parameter of the sensor that carries a gradient.

    It inverts `Sensor.sample_ray`: `film(ray(t), aperture_sample).position()` is the film position that the ray was
    made for.

    Parameters
    ----------
    sensor : mi.Sensor, one of `SENSORS`.

    Raises
    ------
    RuntimeError : the sensor is of another type.
    """

    def __init__(self, sensor: mi.Sensor):
        kind = sensor.class_name()
        if kind not in SENSORS.values():
            raise RuntimeError(
                f'film boundary: sensor "{sensor.id()}" ({kind}) is not supported, use one of {", ".join(SENSORS)}'
            )
        params = mi.traverse(sensor)
        film = sensor.film()
        self.crop_offset = mi.ScalarVector2f(film.crop_offset())
        self.crop_size = mi.ScalarVector2f(film.crop_size())
        self.orthographic = kind == SENSORS["orthographic"]
        self.to_world = sensor.world_transform()
        self.to_local = self.to_world.inverse()
        self.to_sample = sensor.projection_transform().matrix
        # The offsets are relative to the whole film, the sample space to the crop window (as in Mitsuba's
        # `perspective`).
        self.principal_point = mi.Vector2f(0)
        if "principal_point_offset_x" in params:
            offset = mi.Vector2f(params["principal_point_offset_x"], params["principal_point_offset_y"])
            self.principal_point = offset * mi.ScalarVector2f(film.size()) / self.crop_size
        self.aperture_radius = params["aperture_radius"] if kind == SENSORS["thinlens"] else None
        self.focus_distance = sensor.focus_distance()
        self.near, self.far = sensor.near_clip(), sensor.far_clip()
        self.attached = dr.grad_enabled(
            self.to_world, self.to_sample, self.principal_point, self.aperture_radius, self.focus_distance
        )  # fmt: skip

    def film(self, p: mi.Point3f, aperture_sample: mi.Point2f | None = None) -> FilmPoint:
        """Project a point through the centre of the lens, or through the point of the lens that `aperture_sample`
        stands for.

        p : mi.Point3f, (N,), world space, scene units.
        """
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

    def eye(self, aperture_sample: mi.Point2f | None = None) -> mi.Point3f:
        """Centre of the lens, or the point of it that `aperture_sample` stands for: world space. Detached."""
        lens = mi.Point2f(0)
        if aperture_sample is not None:
            lens = mi.warp.square_to_uniform_disk_concentric(aperture_sample) * self.lens_radius()
        return dr.detach(self.to_world) @ mi.Point3f(lens.x, lens.y, 0)

    def view(self) -> mi.Vector3f:
        """Optical axis, world space, unit length. Detached."""
        return dr.normalize(dr.detach(self.to_world) @ mi.Vector3f(0, 0, 1))

    def lens_radius(self) -> mi.Float:
        """Radius of the lens, 0 for a pinhole. Detached."""
        return mi.Float(0) if self.aperture_radius is None else dr.detach(mi.Float(self.aperture_radius))

    def blur(self, point: FilmPoint) -> mi.Float:
        """Largest displacement on the film, times `point.w`, that another point of the lens than its centre makes, in
        pixels. Detached."""
        if self.aperture_radius is None:
            return mi.Float(0)
        scale = dr.abs(dr.detach(self.to_sample)[0, 0]) * self.crop_size.x
        return scale * self.lens_radius() * dr.abs(point.z / dr.detach(self.focus_distance) - 1)

    def pixels_per_unit(self, point: FilmPoint) -> mi.Float:
        """How many pixels a short length across the line of sight covers. Detached."""
        to_sample = dr.detach(self.to_sample)
        scale = dr.maximum(dr.abs(to_sample[0, 0]) * self.crop_size.x, dr.abs(to_sample[1, 1]) * self.crop_size.y)
        if self.orthographic:
            scale *= dr.norm(dr.detach(self.to_local) @ mi.Vector3f(0, 1, 0))
        return scale / dr.abs(point.w)


def frame(film: mi.Film) -> tuple[mi.ScalarPoint2f, mi.ScalarPoint2f]:
    """The part of the film that is sampled, in pixels: the crop window, and the border if the film asks for it."""
    border = film.rfilter().border_size() if film.sample_border() else 0
    lower = mi.ScalarPoint2f(film.crop_offset()) - border
    return lower, lower + mi.ScalarVector2f(film.crop_size()) + 2 * border


def inside_frame(u: mi.Point2f, film: mi.Film) -> mi.Bool:
    lower, upper = frame(film)
    return dr.all((u >= lower) & (u < upper))


def tangent(
    projection: Projection, a: mi.Point3f, b: mi.Point3f, t: mi.Float, aperture_sample: mi.Point2f | None
) -> mi.Vector2f:
    """du/dt along the edges, in pixels: derivative of a quotient of two linear functions."""
    p, q = projection.film(a, aperture_sample), projection.film(b, aperture_sample)
    w = dr.lerp(p.w, q.w, t)
    u = dr.lerp(p.xy, q.xy, t) / w
    return mi.Vector2f((q.xy - p.xy) - u * (q.w - p.w)) / w
