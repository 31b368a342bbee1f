"""Plugin `fisheye`: a camera that sees up to the whole sphere of directions."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.projection.sensors import equidistant, from_equidistant
from rimlight.edge_sampling.refusals import InputError

FOV_AXES = ("x", "y", "diagonal", "smaller", "larger")


class FisheyeSensor(mi.Sensor):
    r"""
    .. _sensor-fisheye:

    Equidistant fisheye camera (:monosp:`fisheye`)
    ----------------------------------------------

    .. pluginparameters::

     * - to_world
       - |transform|
       - Rotation and translation of the camera. It looks along its +z axis, +y is up. (Default: none, that is, the
         camera looks along the +z axis of the world.)
       - |exposed|, |differentiable|, |discontinuous|

     * - fov
       - |float|
       - Angle of view across the image circle in degrees, above 0 and up to 360. (Default: 180)
       - |exposed|, |differentiable|, |discontinuous|

     * - fov_axis
       - |string|
       - Diameter of the image circle: the film's width (``x``) or height (``y``), the ``smaller`` or the ``larger`` of
         them, or the ``diagonal``. (Default: ``x``)

     * - srf
       - |spectrum|
       - Spectral response of the sensor, in spectral variants. (Default: none)

     * - shutter_open, shutter_close
       - |float|
       - Times at which the shutter opens and closes. (Default: 0)

     * - film, sampler
       - |object|
       - As in Mitsuba's cameras. The centre of the image is that of the whole film, whichever crop window is rendered.

    On the film, the distance from the centre is proportional to the angle from the optical axis: with a film position
    :math:`\mathbf u` and the circle's radius :math:`R`, both in pixels from the centre,

    .. math::

        \theta = \frac{|\mathbf u|}{R}\, \frac{\text{fov}}{2} .

    It is the second camera of Li et al. 2018. Outside of the circle, the image is black and transparent, and nothing
    is traced. The circle stays where it is on the film whatever ``fov`` is, so its border adds nothing to a derivative.

    Rays start at the camera's centre, and end nowhere: there are no clipping planes. Nor is there a lens, or an offset
    of the principal point. Works with every integrator of Mitsuba that starts from the camera or from the lights.

    .. tabs::
        .. code-tab:: xml

            <sensor type="fisheye">
                <float name="fov" value="180"/>
                <string name="fov_axis" value="smaller"/>
                <transform name="to_world">
                    <lookat origin="0, 1, -4" target="0, 0, 0" up="0, 1, 0"/>
                </transform>
            </sensor>

        .. code-tab:: python

            'type': 'fisheye',
            'fov': 180,
            'fov_axis': 'smaller',
            'to_world': mi.ScalarTransform4f().look_at(origin=[0, 1, -4], target=[0, 0, 0], up=[0, 1, 0])
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        who = props.plugin_name()
        fov, self.fov_axis = props.get("fov", 180.0), props.get("fov_axis", "x")
        if not 0 < fov <= 360:
            raise InputError(f'{who}: "fov" must be above 0 and at most 360 degrees, got {fov}')
        if self.fov_axis not in FOV_AXES:
            raise InputError(f'{who}: "fov_axis" must be one of {", ".join(FOV_AXES)}, got "{self.fov_axis}"')
        if props.get("to_world", mi.ScalarTransform4f()).has_scale():
            raise InputError(f'{who}: "to_world" must not scale: the angles would no longer be those of the film')
        self.fov = mi.Float(fov)
        self.m_needs_sample_3 = False
        self.parameters_changed([])

    def traverse(self, callback: mi.TraversalCallback) -> None:
        super().traverse(callback)
        flags = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
        callback.put("to_world", self.m_to_world, flags)
        callback.put("fov", self.fov, flags)

    def parameters_changed(self, keys: list[str]) -> None:
        super().parameters_changed(keys)
        dr.make_opaque(self.m_to_world, self.fov)  # lest each value be a part of the kernels

    def to_string(self) -> str:
        return f"FisheyeSensor[fov={self.fov}, fov_axis={self.fov_axis}, to_world={self.m_to_world}]"

    def bbox(self) -> mi.ScalarBoundingBox3f:
        origin = dr.detach(self.world_transform()) @ mi.Point3f(0)
        return mi.ScalarBoundingBox3f(mi.ScalarPoint3f(origin.x[0], origin.y[0], origin.z[0]))

    # ---------------------- The film ----------------------

    def circle_radius(self) -> float:
        """Radius of the image circle, pixels."""
        width, height = self.film().size()
        diameters = {"x": width, "y": height, "smaller": min(width, height), "larger": max(width, height)}
        return 0.5 * diameters.get(self.fov_axis, (width**2 + height**2) ** 0.5)

    def pixels_per_radian(self) -> mi.Float:
        """Pixels on the film for an angle from the optical axis; attached to `fov`."""
        return self.circle_radius() / dr.deg2rad(0.5 * self.fov)

    def _from_centre(self, sample: mi.Point2f) -> mi.Vector2f:
        """A position in the crop window, in [0, 1]²: in pixels from the centre of the film."""
        film = self.film()
        corner = mi.ScalarVector2f(film.crop_offset()) - 0.5 * mi.ScalarVector2f(film.size())
        return mi.Vector2f(sample) * mi.ScalarVector2f(film.crop_size()) + corner

    # ---------------------- Rays ----------------------

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
        u = self._from_centre(sample2)
        inside = dr.squared_norm(u) <= self.circle_radius() ** 2
        to_world = self.world_transform()
        d = to_world @ from_equidistant(u / self.pixels_per_radian())
        # One origin for each ray, as other sensors have it: its gradients are then summed up once, after the rays.
        o = to_world @ mi.Point3f(0) + dr.zeros(mi.Vector3f, dr.width(d))
        ray = mi.Ray3f(o, d, time, wavelengths)
        ray.maxt = dr.select(inside, dr.largest(mi.Float), 0)
        return ray, dr.select(inside, weight, 0)

    def sample_direction(self, it, sample, active=True):
        film, to_world = self.film(), self.world_transform()
        q = to_world.inverse() @ it.p
        angle, distance = equidistant(q), dr.norm(q)
        u = angle * self.pixels_per_radian()
        size = mi.ScalarVector2f(film.crop_size())
        ds = dr.zeros(mi.DirectionSample3f, dr.width(it.p))
        ds.uv = mi.Point2f(u + 0.5 * mi.ScalarVector2f(film.size()) - mi.ScalarVector2f(film.crop_offset()))
        active = mi.Bool(active) & (distance > 0) & (dr.squared_norm(u) <= self.circle_radius() ** 2)
        active &= dr.all((ds.uv >= 0) & (ds.uv <= size))
        ds.p = to_world @ mi.Point3f(0)
        ds.d = (ds.p - it.p) / distance
        ds.dist = distance
        ds.n = to_world @ mi.Vector3f(0, 0, 1)
        ds.pdf = dr.select(active, mi.Float(1), 0)
        # Part of the crop window that a unit of solid angle covers: θ dθ dφ on the film for sin θ dθ dφ.
        θ = dr.sqrt(dr.maximum(dr.squared_norm(angle), 1e-12))
        importance = dr.square(self.pixels_per_radian()) * (θ / dr.sin(θ)) / (size.x * size.y)
        return ds, dr.select(active, mi.Spectrum(importance / dr.square(distance)), 0)


mi.register_sensor("fisheye", FisheyeSensor)
