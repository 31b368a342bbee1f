"""The film boundary: what edges that move over the film add to the derivative of an image.

For a pixel with filter k, I = ∫ k(u) L(u) du. Where an edge moves with the velocity du/dθ, its derivative gains

    ∮ k(u) · (L⁻ − L⁺) · (n · du/dθ) dl,        n: unit normal of the edge on the film, from the − side to the + side

(Li et al. 2018, Eq. 7, with the edge function's gradient written as a velocity). With the edge as a curve u(t), the
length element and the normal join to n dl = (−u'ᵧ, u'ₓ) dt, so that neither is ever normalised.

Besides the edges of meshes, the image jumps at the cuts that the sensor's near clipping plane makes through faces,
where interpolated normals turn away from the viewer (`horizon.py`), and at the outlines of spheres, disks, cylinders.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.geometry.curves import Curves
from rimlight.edge_sampling.geometry.device_edges import DeviceEdges, line_of_sight
from rimlight.edge_sampling.geometry.edges import Edges
from rimlight.edge_sampling.geometry.meshes import Geometry
from rimlight.edge_sampling.lights import Lights
from rimlight.edge_sampling.projection.sensors import Projection, inside_frame

from .horizon import Horizon, HorizonPoint, Horizons
from .tracer import Tracer

#: Lengths on the film are added up as whole numbers of this many pixels: integer sums do not depend on their order, so
#: an edge that cannot be seen changes nothing, not even the last bit.
LENGTH_UNIT = 2.0**-16

#: How far beside the edges of meshes that light goes through to look, in units of the offset of Mitsuba's rays.
BEHIND = 8


@dataclass(frozen=True)
class BoundarySamples:
    """Samples of the film boundary.

    position : mi.Point2f, (N,), pixels, detached; where to splat.
    value    : mi.Spectrum, (N,), zero, with the gradient of (L⁻ − L⁺) · (n · du/dθ) dl in pixels².
    alpha    : mi.Float, (N,), the same for the alpha channel.
    wavelengths : mi.Spectrum or empty.
    """

    position: mi.Point2f
    value: mi.Spectrum
    alpha: mi.Float
    wavelengths: mi.Spectrum


@dataclass(frozen=True)
class BoundaryPoints:
    """Points on edges, as the sensor sees them.

    position : mi.Point2f, (N,), pixels, detached.
    n_dl     : mi.Vector2f, (N,), n dl over the density of the points, pixels; zero where there is none. Detached.
    velocity : mi.Vector2f, (N,), zero, with the gradient du/dθ of the position.
    rays     : that look beside the edge, on its − and on its + side.
    weights  : of these rays.
    active   : mi.Bool, (N,)
    horizons : on which side of a horizon of interpolated normals each of the rays is; None where there are none.
    sensor_moves : does the velocity depend on parameters of the sensor?
    """

    position: mi.Point2f
    n_dl: mi.Vector2f
    velocity: mi.Vector2f
    rays: list[mi.RayDifferential3f]
    weights: list[mi.Spectrum]
    active: mi.Bool
    horizons: list[Horizon | None]
    sensor_moves: bool


class FilmBoundary:
    """Samples the edges of a scene on the film of a sensor.

    Parameters
    ----------
    geometry : the shapes.
    edges : of their meshes, on the host.
    moving : see `Geometry.moving`; which of them can move over the film.
    lights : of the scene.
    soft : are there lights with a size, or light that is scattered? Then a part of it may lie behind one face of a
        smooth-shaded mesh, but not behind the next, and what is seen jumps at the edge (see `face_planes.py`).
    """

    DRJIT_STRUCT = dict.fromkeys(
        ("edges", "corners", "horizons", "curves", "counts", "lights", "transmit", "soft")
    )  # for `dr.freeze`

    def __init__(self, geometry: Geometry, edges: Edges, moving: np.ndarray, lights: Lights, *, soft: bool):
        self.geometry, self.lights, self.soft = geometry, lights, soft
        edges, faces = edges.of_meshes(moving), geometry.faces(moving)
        # (Dr.Jit 1.5 cannot freeze empty arrays.)
        self.edges = DeviceEdges(edges) if len(edges) else None
        self.corners = [mi.UInt32(np.ascontiguousarray(faces[:, k])) for k in range(3)] if len(edges) else []
        shapes = zip(geometry.analytic, moving[len(geometry.meshes) :], strict=True)
        shapes = tuple(s for s, moves in shapes if moves)
        self.curves = Curves(shapes) if shapes else None
        horizons = Horizons(geometry, moving[: len(geometry.meshes)])
        self.horizons = horizons if len(horizons) else None
        #: How many edges, then cuts through faces, then faces with horizons, then pieces of curves there are.
        cuts = len(faces) if len(edges) else 0
        self.counts = (len(edges), cuts, len(horizons), len(self.curves) if shapes else 0)
        self.transmit = self._transmitting(edges, faces)

    def _transmitting(self, edges: Edges, faces: np.ndarray) -> mi.Bool | None:
        """Which edges, cuts, horizons and pieces of curves, in this order, are on a mesh that light goes through? None
        if it goes through none of the meshes."""
        meshes = self.geometry.meshes
        transmits = [m.bsdf() is not None and bool(m.bsdf().flags() & mi.BSDFFlags.Transmission) for m in meshes]
        if not any(transmits):
            return None
        vertex = np.repeat(transmits, [m.vertex_count() for m in meshes])
        first = [edges.vertices[:, 0, 0], faces[:, 0] if len(edges) else []]
        first.append(self.horizons.faces[:, 0] if self.horizons is not None else [])
        parts = [vertex[np.asarray(v, np.int64)] for v in first]
        return mi.Bool(np.concatenate([*parts, np.zeros(self.counts[3], bool)]))

    def sample(
        self,
        tracer: Tracer,
        sensor: mi.Sensor,
        sampler: mi.Sampler,
        count: int,
    ) -> BoundarySamples:
        """Estimate the boundary integral over the whole film with `count` samples, whose sum is the estimate.

        Edges are chosen in proportion to their length on the film, and points uniformly along them, both by one
        stratified number. Where edges are curves on the film, angles from the eye stand for lengths.

        sampler : seeded for `count` lanes.
        tracer : tells what is `seen` on both sides of the edge, with equal random numbers, so that an edge that is
            hidden, or across which nothing jumps, contributes next to nothing rather than noise.

        Bias: the two sides are looked at a distance `_offset` from the edge; what changes on that scale is smeared by
        it, and folds of faces that are narrower on the film do not count.
        """
        with dr.suspend_grad():
            points = self.points(tracer.scene, sensor, sampler, count)
            jump, alpha_jump = mi.Spectrum(0), mi.Float(0)
            sides = zip((-1, 1), points.rays, points.weights, points.horizons, strict=True)
            for sign, ray, weight, horizon in sides:
                L, alpha = tracer.seen(ray, sampler.clone(), points.active, horizon)
                jump -= sign * L * weight
                alpha_jump -= sign * alpha
            if points.sensor_moves:
                # The gradient of each number of the sensor is a kernel of its own: let none of them trace rays again.
                dr.eval(jump, alpha_jump, points.n_dl)
        with dr.resume_grad():
            normal_velocity = dr.dot(points.n_dl, points.velocity)
            wavelengths = points.rays[1].wavelengths
            return BoundarySamples(points.position, jump * normal_velocity, alpha_jump * normal_velocity, wavelengths)

    def points(self, scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler, count: int) -> BoundaryPoints:
        """Points of the film boundary, of which `sample` makes samples."""
        with dr.resume_grad():
            projection = Projection(sensor)
            positions = self.geometry.positions()
            frames = self.curves.frames() if self.curves is not None else None
            normals = self.geometry.normals() if self.horizons is not None else None
        with dr.suspend_grad():
            aperture_sample = sampler.next_2d() if sensor.needs_aperture_sample() else None
            # Where interpolated normals go on being lit, the shadow of a mesh on itself begins at edges that are
            # silhouettes as seen from a light: that is a jump, too, if the light has no size.
            smooth = self.edges is not None and self.edges.any_smooth
            lights = self.lights.places(scene) if smooth else None
            lengths = self._visible_lengths(projection, positions, normals, frames, lights)
            index, along, density = self._choose(lengths, sampler, count)
            is_edge, is_line = index < self.counts[0], index < sum(self.counts[:2])
            is_curve = index >= sum(self.counts[:3])
            along_film, valid = mi.Vector2f(0), mi.Bool(False)
            if self.edges is not None:
                a, b = self._end_points(projection, positions, index)
                visible = projection.clip(a, b)
                t, dt = visible.parameter(along)
                along_film, valid = projection.tangent(a, b, t, aperture_sample) * dt, is_line & (visible.length > 0)
            if self.curves is not None:
                eye = -projection.view() if projection.orthographic else projection.eye(aperture_sample)
                piece = dr.select(is_curve, index - sum(self.counts[:3]), 0)
                c = self.curves.point(frames, piece, along, eye, projection.orthographic)
                on_film = projection.tangent(c.p, mi.Point3f(c.p + c.tangent), mi.Float(0), aperture_sample)
                along_film = dr.select(is_curve, on_film, along_film)
                valid |= is_curve & c.valid & (projection.film(c.p).z > projection.near)
            facing = mi.Vector2f(0)
            if self.horizons is not None:
                is_horizon = ~is_line & ~is_curve
                face = dr.select(is_horizon, index - sum(self.counts[:2]), 0)
                h = self._horizon_point(projection, positions, normals, face, along, aperture_sample)
                across = lambda v: projection.tangent(h.p, mi.Point3f(h.p + v), mi.Float(0), aperture_sample)
                along_film = dr.select(is_horizon, across(h.tangent), along_film)
                facing = across(h.facing)
                valid |= is_horizon & h.valid & (projection.film(h.p).z > projection.near)
            valid &= (density > 0) & dr.isfinite(dr.squared_norm(along_film))

        # Only here does the gradient enter: the velocity of a point that is fixed on the edge.
        with dr.resume_grad():
            p = mi.Point3f(0)
            if self.edges is not None:
                p = dr.lerp(*self._end_points(projection, positions, index), t)
            if self.curves is not None:
                c = self.curves.point(frames, piece, along, eye, projection.orthographic)
                p = dr.select(is_curve, c.p, p)
            if self.horizons is not None:
                h = self._horizon_point(projection, positions, normals, face, along, aperture_sample)
                p = dr.select(is_horizon, h.p, p)
            # What is not visible has no place on the film: any point in front of the sensor stands for it, for even
            # with the value zero, a sample at a position that is not finite would spoil a pixel.
            p = dr.select(valid, p, mi.Point3f(projection.eye() + projection.view()))
            u = projection.film(p, aperture_sample).position()
            velocity = u - dr.detach(u)

        with dr.suspend_grad():
            n_dl = mi.Vector2f(-along_film.y, along_film.x) / density
            if self.horizons is not None:
                # From where normals face away to where they do not.
                n_dl = dr.select(is_horizon, dr.mulsign(n_dl, dr.dot(n_dl, facing)), n_dl)
            n = dr.normalize(n_dl)
            u, p = dr.detach(u), dr.detach(p)
            offset = self._offset(projection, p, index) * n
            active = valid & dr.isfinite(dr.squared_norm(n_dl)) & inside_frame(u, sensor.film())
            time = sensor.shutter_open()
            if sensor.shutter_open_time() > 0:
                time += sampler.next_1d() * sensor.shutter_open_time()
            wavelength_sample = sampler.next_1d() if mi.is_spectral else 0.0
            rays, weights = [], []
            for sign in (-1, 1):
                ray, weight = sensor.sample_ray_differential(
                    time,
                    wavelength_sample,
                    (u + sign * offset - projection.crop_offset) / projection.crop_size,
                    mi.Point2f(0.5) if aperture_sample is None else aperture_sample,
                    active,
                )
                rays.append(ray)
                weights.append(weight)
            if self.edges is not None:
                edge = dr.select(is_edge, index, 0)
                # (Beside horizons, of which what hides an edge may have one, more than its shape matters.)
                hides = (scene, active & is_edge) if self.horizons is not None else ()
                active &= ~(is_edge & self.edges.is_hidden_fold(positions, edge, p, rays, *hides))
            if self.horizons is not None:
                active &= ~is_horizon | self.horizons.sees_dark_side(scene, face, p, rays[0], active & is_horizon)
            if self.curves is not None:
                # Where a rim of a cylinder comes close to its contour, the ray on the side of the wall may pass beyond
                # that: a jump of the contour's, which would count twice.
                wall = projection.tangent(c.p, mi.Point3f(c.p + c.inwards), mi.Float(0), aperture_sample)
                missed = [self.curves.misses(frames, piece, ray) for ray in rays]
                active &= ~is_curve | ~dr.select(dr.dot(wall, n) > 0, missed[1], missed[0])
            horizons = [None, None]
            if self.horizons is not None:
                side = mi.Float(0)
                if self.edges is not None:
                    # Where a curve runs between the two rays beside an edge, its jump is not that of the edge.
                    sight = line_of_sight(p, rays)
                    side = self.edges.facing(normals, self.horizons.sign, edge, t, -sight)
                    side = dr.select(is_edge & self.edges.is_fold(positions, edge, p, sight), side, 0)
                horizons = [Horizon(dr.select(is_horizon, mi.Float(sign), side), p, is_horizon) for sign in (-1, 1)]
            n_dl = dr.select(active, n_dl, 0)
            return BoundaryPoints(u, n_dl, velocity, rays, weights, active, horizons, projection.attached)

    def _horizon_point(self, projection: Projection, positions, normals, face, s, aperture_sample) -> HorizonPoint:
        eye, far = projection.viewer(aperture_sample), projection.orthographic
        return self.horizons.point(positions, normals, face, s, eye, far)

    def _choose(self, lengths: mi.Float, sampler: mi.Sampler, count: int) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        """Choose edges in proportion to their length on the film.

        Returns
        -------
        index : mi.UInt32, (count,), of an edge, a cut, or a piece of a curve
        along : mi.Float, (count,), position along its visible part, uniform in [0, 1) on the film.
        density : mi.Float, (count,), expected number of samples on the edge; 0 where no edge is visible.
        """
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
        return index, along, dr.select(total > 0, mi.Float(count * size / total), 0)

    def _jumps(self, projection: Projection, positions: mi.Float, edge: mi.UInt32) -> mi.Bool:
        """Does something jump at the edge, as seen from the sensor?"""
        return self.edges.is_boundary(
            positions,
            edge,
            projection.eye(),
            view=projection.view() if projection.orthographic else None,
            radius=projection.lens_radius(),
            geometry=self.geometry,
        )

    def _visible_lengths(
        self,
        projection: Projection,
        positions: mi.Float,
        normals: mi.Float | None,
        frames: mi.Float | None,
        lights: mi.Vector4f | None,
    ) -> mi.Float:
        """Length inside the frame of each edge, cut, horizon and piece of a curve, 0 where nothing can jump: pixels on
        the film; less where little jumps; of horizons and curves, an estimate."""
        lengths = []
        if self.edges is not None:
            edge, face = (dr.arange(mi.UInt32, n) for n in self.counts[:2])
            jumps = self._jumps(projection, positions, edge)
            if lights is not None:
                jumps |= self.edges.is_silhouette_of_any(positions, edge, lights)
            for a, b in (self.edges.end_points(positions, edge), self._cut(projection, positions, face)):
                lengths.append(projection.clip(a, b).length)
            # The less faces turn, the less their planes hide: about as the square of the angle.
            bend = self.edges.bend(positions, edge) * lengths[0] if self.soft and self.edges.any_smooth else 0
            lengths[0] = dr.select(jumps, lengths[0], bend)
        if self.horizons is not None:
            face = dr.arange(mi.UInt32, self.counts[2])
            eye, far, radius = projection.viewer(), projection.orthographic, projection.lens_radius()
            a, b, possible = self.horizons.chords(positions, normals, face, eye, far, radius)
            length = projection.clip(a, b).length
            lengths.append(dr.select(possible, length, 0))
        if self.curves is not None:
            lengths.append(self._curve_length(projection, frames))
        return dr.concat(lengths) if len(lengths) > 1 else lengths[0]

    def _curve_length(self, projection: Projection, frames: mi.Float) -> mi.Float:
        """About the length of each piece of a curve, 0 only where it is certainly out of the frame."""
        piece = dr.arange(mi.UInt32, self.counts[3])
        eye = -projection.view() if projection.orthographic else projection.eye()
        lower, upper = projection.frame
        points = [
            projection.film(self.curves.point(frames, piece, mi.Float(t), eye, projection.orthographic).p)
            for t in (0, 0.5, 1)
        ]
        start, middle, end = (q.position() for q in points)
        length = dr.norm(middle - start) + dr.norm(end - middle)
        size = dr.norm(mi.Vector2f(upper - lower))
        # Another point of the lens may see all of it elsewhere.
        blur = sum(projection.blur(q) / dr.abs(q.w) for q in points)
        outside = mi.Bool(False)
        for i in (0, 1):
            outside |= (middle[i] + length + blur < lower[i]) | (middle[i] - length - blur > upper[i])
        in_front = [q.z > projection.near for q in points]
        whole = in_front[0] & in_front[1] & in_front[2] & dr.isfinite(length)
        length = dr.select(outside, 0, dr.minimum(length, size) + LENGTH_UNIT)
        length = dr.select(whole, length, dr.select(in_front[0] | in_front[1] | in_front[2], size, 0))
        return length

    def _end_points(
        self, projection: Projection, positions: mi.Float, index: mi.UInt32
    ) -> tuple[mi.Point3f, mi.Point3f]:
        """End points of edges, or beyond their number of cuts: world space."""
        edges, faces = self.counts[:2]
        is_edge, is_face = index < edges, (index >= edges) & (index < edges + faces)
        edge = self.edges.end_points(positions, dr.select(is_edge, index, 0))
        cut = self._cut(projection, positions, dr.select(is_face, index - edges, 0))
        return tuple(dr.select(is_edge, e, c) for e, c in zip(edge, cut, strict=True))

    def _cut(self, projection: Projection, positions: mi.Float, face: mi.UInt32) -> tuple[mi.Point3f, mi.Point3f]:
        """End points of the cut of the near clipping plane through faces; NaN where there is none. World space."""
        corners = [dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, corner, face)) for corner in self.corners]
        depth = [projection.film(p).z - projection.near for p in corners]
        # The corner that has the plane between itself and the two others, first.
        front = [d > 0 for d in depth]
        for k in (1, 2):
            alone = (front[k] != front[0]) & (front[k] != front[3 - k])
            corners[0], corners[k] = dr.select(alone, corners[k], corners[0]), dr.select(alone, corners[0], corners[k])
            depth[0], depth[k] = dr.select(alone, depth[k], depth[0]), dr.select(alone, depth[0], depth[k])
        crossed = (front[0] != front[1]) | (front[0] != front[2])
        points = []
        for k in (1, 2):
            t = depth[0] / dr.select(crossed, depth[0] - depth[k], 1)
            points.append(dr.select(crossed, dr.lerp(corners[0], corners[k], t), dr.nan))
        return points[0], points[1]

    def _offset(self, projection: Projection, p: mi.Point3f, index: mi.UInt32) -> mi.Float:
        """How far beside the edge to look, in pixels: just beyond what single precision can tell apart."""
        ulp = dr.epsilon(mi.Float) * 2
        largest = dr.maximum(dr.max(dr.abs(p)), dr.max(dr.abs(projection.eye())))
        in_world = 8 * ulp * largest
        if self.transmit is not None:
            # Mitsuba's rays start so far from a surface: beside the edge of glass, beyond the face on the other side.
            behind = BEHIND * mi.math.RayEpsilon * (1 + dr.max(dr.abs(p)))
            in_world += dr.select(dr.gather(mi.Bool, self.transmit, index), behind, 0)
        in_world *= projection.pixels_per_unit(projection.film(p))
        on_film = 8 * ulp * max(projection.crop_size + projection.crop_offset)
        return in_world + on_film
