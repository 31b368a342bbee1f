"""The planes of the faces of smooth-shaded lamps: on which side of them what is lit lies.

Mitsuba reckons the light that a face T throws with the interpolated normal nₛ of its points y. So a point x still
receives light from the whole face at the moment at which it comes to lie behind its plane, and the lamp itself hides
the face: the image jumps along the line in which the plane with the normal n cuts what is lit,

    n · (x − y) = 0.

Of one point y of the face, and one direction ω in its plane, x is where a ray meets a surface. From there, this is a
boundary as the shadow of an edge is one (`shadow_boundary.py`), with the line y + ω as the edge: lit is what lies above
the plane. Which point of the face is taken does not matter to its plane, so that x moves as the plane and what it cuts
do, however near the lamp is.

What jumps is small where faces are: in proportion to how far nₛ is from n.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.choice.sampling import power_heuristic
from rimlight.edge_sampling.geometry.beside import beside_edge
from rimlight.edge_sampling.geometry.meshes import Geometry, is_flipped
from rimlight.edge_sampling.parametrisation import material_point
from rimlight.edge_sampling.projection.sensors import Projection
from rimlight.edge_sampling.smooth_lamps import SmoothLamps

from .fallen_shadow import LightPoint, LitEdge, SeenShadow, Shadow, across_border, fall, look
from .fine_mirrors import fringe
from .shadow_boundary import ShadowSamples
from .tracer import Tracer


class LampPlanes:
    """Samples the planes of the faces of some lamps.

    geometry : the shapes.
    lamps : for each of its meshes, the number of its emitter in the scene, or -1 if it does not count.
    """

    DRJIT_STRUCT = dict.fromkeys(("_corners", "_sign", "_emitter", "count"))  # for `dr.freeze`

    def __init__(self, geometry: Geometry, lamps: list[int]):
        self._geometry = geometry
        wanted = [(m, i) for m, i in zip(geometry.meshes, lamps, strict=True) if i >= 0]
        faces = geometry.faces(tuple(i >= 0 for i in lamps))
        opaque = dr.opaque(mi.UInt32, 0)  # (Not in NumPy's memory, for frozen functions.)
        of_faces = lambda values: np.repeat(values, [m.face_count() for m, _ in wanted])
        self._corners = [mi.UInt32(np.ascontiguousarray(faces[:, k])) + opaque for k in range(3)]
        self._sign = mi.Float(of_faces([-1.0 if is_flipped(m) else 1.0 for m, _ in wanted])) * dr.opaque(mi.Float, 1)
        self._emitter = mi.UInt32(of_faces([i for _, i in wanted])) + opaque
        #: Number of faces.
        self.count = len(faces)

    @staticmethod
    def of(scene: mi.Scene, geometry: Geometry, least: float) -> LampPlanes | None:
        """Of the lamps whose normals differ so much from those of their faces: see `fringe`. None: there are none."""
        smooth = SmoothLamps.shapes(scene)
        shapes = [e.get_shape() for e in scene.emitters()]
        coarse = lambda m: m in smooth and fringe(m) > least
        lamps = [shapes.index(m) if coarse(m) else -1 for m in geometry.meshes]
        return LampPlanes(geometry, lamps) if any(i >= 0 for i in lamps) else None

    def sample(self, tracer: Tracer, sensor: mi.Sensor, sampler: mi.Sampler) -> ShadowSamples:
        """Choose points of faces and directions in their planes, one of each for every lane."""
        count = sampler.wavefront_size()
        with dr.resume_grad():
            projection, positions = Projection(sensor), self._geometry.positions()
        with dr.suspend_grad():
            time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
            face, light, b = self._point(tracer.scene, dr.detach(positions), time, sampler)
            p, sides = self._face(dr.detach(positions), face)
            n = dr.normalize(dr.cross(*sides)) * dr.gather(mi.Float, self._sign, face)
            n = dr.mulsign(n, dr.dot(n, light.n))
            s, c = dr.sincos(dr.two_pi * sampler.next_1d())
            frame = mi.Frame3f(n)
            ω = frame.s * c + frame.t * s
            edge = LitEdge(None, light.y, dr.cross(n, ω), n, ω, ω, light.density > 0)
            shadow = fall(tracer.scene, light, edge)
            shadow.active &= self._hidden_below(tracer.scene, light, edge, shadow)
            view = look(tracer, projection, sensor, sampler, time, shadow)
            jump = self._jump(tracer, light, view)

            # ---------------------- The boundary on the film ----------------------

            across = across_border(projection, light, edge, shadow, view)
            n_dl = across * (dr.two_pi / (light.density * count))
            active = view.active & dr.isfinite(dr.squared_norm(n_dl)) & dr.any(jump != 0)
            n_dl, u = dr.select(active, n_dl, 0), dr.select(active, view.u, 0)
            # The direction, in parts of the two sides of the face with which it moves.
            front = dr.cross(*sides)
            parts = (dr.dot(dr.cross(*pair), front) for pair in ((ω, sides[1]), (sides[0], ω)))
            a = dr.select(active, mi.Vector2f(*parts) / dr.squared_norm(front), 0)
            if projection.attached:
                dr.eval(jump, n_dl, active, view.seen, view.ray, face, a, b, shadow.facing, shadow.lift, u)
        with dr.resume_grad():
            m = material_point(view.ray, view.seen, active).p
            p, sides = self._face(positions, face)
            in_plane = lambda parts: parts.x * sides[0] + parts.y * sides[1]
            origin, d = p + in_plane(b), in_plane(a)
            cos = dr.select(active, dr.dot(shadow.facing, d), 1)
            s = (dr.dot(shadow.facing, m - origin) + shadow.lift) / cos
            x = mi.Point3f(origin + dr.select(active, s, 1) * d - shadow.facing * shadow.lift)
            moved = projection.film(x, view.aperture_sample).position()
            velocity = dr.select(active, moved - dr.detach(moved), 0)
            if tracer.held is not None:
                velocity -= tracer.held.velocity(view.ray, view.seen, active, projection, view.aperture_sample)
            return ShadowSamples(u, jump * dr.dot(n_dl, velocity), view.ray.wavelengths, light.light)

    def _point(
        self, scene: mi.Scene, positions: mi.Float, time: mi.Float, sampler: mi.Sampler
    ) -> tuple[mi.UInt32, LightPoint, mi.Point2f]:
        """A face, a point of it, and where that is, in parts of the two sides of the face."""
        face, density = self._choose(positions, sampler.next_1d())
        p, sides = self._face(positions, face)
        area, b = 0.5 * dr.norm(dr.cross(*sides)), mi.warp.square_to_uniform_triangle(sampler.next_2d())
        of_corners = self._normals(face)
        n = of_corners[0] + b.x * (of_corners[1] - of_corners[0]) + b.y * (of_corners[2] - of_corners[0])
        emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), dr.gather(mi.UInt32, self._emitter, face))
        on_surface, nothing = dr.full(mi.Bool, True, dr.width(face)), mi.Float(0)
        density = dr.select(area > 0, density / area, 0)
        y = mi.Point3f(p + b.x * sides[0] + b.y * sides[1])
        which = mi.UInt32(0), emitter, nothing, time, mi.Point2f(0)
        return face, LightPoint(*which, on_surface, ~on_surface, y, dr.normalize(n), density), b

    def _face(self, positions: mi.Float, face: mi.UInt32) -> tuple[mi.Point3f, tuple[mi.Vector3f, mi.Vector3f]]:
        """The first corner of a face, and from there the two sides."""
        p, q, r = (dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, c, face)) for c in self._corners)
        return p, (q - p, r - p)

    def _normals(self, face: mi.UInt32) -> list[mi.Vector3f]:
        """Of the corners, not normalised, as Mitsuba has them."""
        normals, sign = dr.detach(self._geometry.normals()), dr.gather(mi.Float, self._sign, face)
        return [sign * dr.gather(mi.Vector3f, normals, dr.gather(mi.UInt32, c, face)) for c in self._corners]

    def _choose(self, positions: mi.Float, x: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """A face, by its area and how far the normals of its corners are from its own, and the probability."""
        every = dr.arange(mi.UInt32, self.count)
        _, sides = self._face(positions, every)
        front, off = dr.cross(*sides), mi.Float(0)
        for normal in self._normals(every):
            sine = dr.norm(dr.cross(front, normal)) / dr.norm(normal)
            off = dr.maximum(off, dr.select(dr.isfinite(sine), sine, 0))
        sums, last = dr.cumsum(off), self.count - 1
        x = x * dr.gather(mi.Float, sums, last)
        face = dr.binary_search(0, last, lambda i: dr.gather(mi.Float, sums, i) <= x)
        return face, dr.gather(mi.Float, off, face) / dr.gather(mi.Float, sums, last)

    @staticmethod
    def _hidden_below(scene: mi.Scene, light: LightPoint, edge: LitEdge, shadow: Shadow) -> mi.Bool:
        """Does the lamp, or what stands behind it, hide the face from just below its plane? An open sheet does not."""
        below = mi.Ray3f(light.y - edge.lit * beside_edge(light.y, light.y), edge.ω, light.time, shadow.ray.wavelengths)
        below.maxt = shadow.fallen.t * (1 - mi.math.ShadowEpsilon)
        return scene.ray_test(below, shadow.active)

    @staticmethod
    def _jump(tracer: Tracer, light: LightPoint, view: SeenShadow) -> mi.Spectrum:
        """The radiance that the sensor sees of a point of a lamp just above the plane of its face: all of it is of
        light samples, since the true cosine is 0."""
        scene, si, active = tracer.scene, view.si, view.active
        ds = dr.zeros(mi.DirectionSample3f, dr.width(active))
        ds.p, ds.n, ds.time, ds.emitter, d = light.y, light.n, light.time, light.emitter, light.y - si.p
        ds.dist = dr.norm(d)
        ds.d = d / ds.dist
        cos = -dr.dot(light.n, ds.d)
        active &= cos > 0
        f, pdf = si.bsdf().eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active)
        weight = power_heuristic(scene.pdf_emitter_direction(si, ds, active), pdf)
        y = dr.zeros(mi.SurfaceInteraction3f, dr.width(active))
        y.p, y.wi, y.wavelengths = light.y, mi.Vector3f(0, 0, 1), view.ray.wavelengths
        L = light.emitter.eval(y, active) * (weight * cos / dr.square(ds.dist))
        return dr.select(active, f * L * view.weight, 0)
