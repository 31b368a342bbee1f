"""The film boundary: what edges that move over the film add to the derivative of an image.

For a pixel with filter k, I = ∫ k(u) L(u) du. Where an edge moves with the velocity du/dθ, its derivative gains

    ∮ k(u) · (L⁻ − L⁺) · (n · du/dθ) dl,        n: unit normal of the edge on the film, from the − side to the + side

(Li et al. 2018, Eq. 7, with the edge function's gradient written as a velocity). With the edge as a curve u(t), the
length element and the normal join to n dl = (−u'ᵧ, u'ₓ) dt, so that neither is ever normalised.

Besides the edges of meshes, the image jumps at the cuts that the sensor's near clipping plane makes through faces and
through spheres, disks and cylinders, where interpolated normals turn away from the viewer (`horizon.py`), and at the
outlines of spheres, disks, cylinders and tubes.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from functools import partial, reduce

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.first_points import FirstPoints
from rimlight.edge_sampling.geometry.beside import are_edge_on, compare_depth, line_of_sight, rounding
from rimlight.edge_sampling.geometry.edges import Edges
from rimlight.edge_sampling.geometry.meshes import Geometry, lets_rays_through
from rimlight.edge_sampling.geometry.surfaces import GOES_ON
from rimlight.edge_sampling.lights import Lights
from rimlight.edge_sampling.projection.sensors import Projection, inside_frame

from .both_sides import Beside
from .crease import Crease, Directions, LuneOrCrease
from .film_outlines import Chosen, FilmOutlines, Found, Placed
from .grid_outlines import on_grids
from .horizon import BESIDE, Horizon
from .lune import Lune
from .tracer import Tracer
from .veils import Before, behind_veils

#: A line of a texture is seen, and what an outline belongs to is met, if what both rays meet is at most so many times
#: as far from its plane as they are beside it.
BENT = 4

#: What perfect mirrors do, and all that lets light through.
STRAIGHT = int(mi.BSDFFlags.Delta | mi.BSDFFlags.Transmission)


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
    met      : what they meet.
    weights  : of these rays.
    active   : mi.Bool, (N,)
    horizons : on which side of a horizon of interpolated normals each of the rays is; None where there are none.
    directions : from where light is looked for on both sides, where it is active; None: as everywhere.
    before   : what lies before the edge; None where there are no veils.
    sensor_moves : does the velocity depend on parameters of the sensor?
    aperture_sample : see `Projection.film`.
    """

    position: mi.Point2f
    n_dl: mi.Vector2f
    velocity: mi.Vector2f
    rays: list[mi.RayDifferential3f]
    met: list[mi.PreliminaryIntersection3f]
    weights: list[mi.Spectrum]
    active: mi.Bool
    horizons: list[Horizon | None]
    directions: Directions | None
    before: Before | None
    sensor_moves: bool
    aperture_sample: mi.Point2f | None


class FilmBoundary:
    """Samples the edges of a scene on the film of a sensor.

    Parameters
    ----------
    geometry : the shapes.
    edges : of their meshes, on the host.
    moving : see `Geometry.moving`; which of them can move over the film.
    turning : of the meshes, which have vertex normals that change.
    lights : of the scene.
    soft : are there lights with a size, or light that is scattered? Then a part of it may lie behind one face of a
        smooth-shaded mesh, but not behind the next, and what is seen jumps at the edge (see `face_planes.py`).
    seams : do the seams of the texture coordinates of spheres, disks and cylinders count?
    channels : is it other channels than light that jump? Those of perfect mirrors do so at edges as well.
    """

    DRJIT_STRUCT = dict.fromkeys(("outlines", "lights", "veils"))  # for `dr.freeze`

    def __init__(
        self,
        geometry: Geometry,
        edges: Edges,
        moving: np.ndarray,
        lights: Lights,
        *,
        soft: bool,
        turning: np.ndarray | bool = False,
        seams: bool = False,
        channels: bool = False,
    ):
        self.lights = lights
        self.veils = any(lets_rays_through(s) for s in (*geometry.known, *geometry.others))
        which = {"soft": soft, "seams": seams, "channels": channels}
        self.outlines = FilmOutlines(geometry, edges, moving, turning, **which)

    @property
    def edge_count(self) -> int:
        """Number of edges, and of pieces of curves."""
        return self.outlines.counts[0] + self.outlines.counts[3]

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
        tracer : tells what is `seen` on both sides of the edge, with equal random numbers, so that an edge across which
            nothing jumps contributes next to nothing rather than noise.

        Bias: the two sides are looked at a distance `_offset` from the edge; what changes on that scale is smeared by
        it, and folds of faces that are narrower on the film do not count.
        """
        with dr.suspend_grad():
            points = self.points(tracer, sensor, sampler, count)
            jump, alpha_jump, seen = mi.Spectrum(0), mi.Float(0), []
            sides = zip((-1, 1), points.rays, points.met, points.weights, points.horizons, strict=True)
            for sign, ray, pi, weight, horizon in sides:
                directions, before = points.directions, points.before
                L, alpha = tracer.seen(ray, pi, sampler.clone(), points.active, horizon, directions, before)
                seen.append(sign * L * weight)
                jump -= seen[-1]
                alpha_jump -= sign * alpha
            if points.sensor_moves:
                # The gradient of each number of the sensor is a kernel of its own: let none of them trace rays again.
                dr.eval(jump, alpha_jump, points.n_dl)
        with dr.resume_grad():
            normal_velocity = dr.dot(points.n_dl, points.velocity)
            value = jump * normal_velocity
            if tracer.held is not None:
                value += self._with_sides(tracer.held, sensor, points, seen)
            wavelengths = points.rays[1].wavelengths
            return BoundarySamples(points.position, value, alpha_jump * normal_velocity, wavelengths)

    @staticmethod
    def _with_sides(held: FirstPoints, sensor: mi.Sensor, points: BoundaryPoints, seen: list) -> mi.Spectrum:
        """What the motion of what is held does on both sides. seen : radiance there, with the signs of the sides."""
        value, projection = mi.Spectrum(0), Projection(sensor)
        dr.eval(seen, points.rays, points.met, points.n_dl)
        for ray, pi, L in zip(points.rays, points.met, seen, strict=True):
            velocity = held.velocity(ray, pi, points.active, projection, points.aperture_sample)
            value += L * dr.dot(points.n_dl, velocity)
        return value

    def points(self, tracer: Tracer, sensor: mi.Sensor, sampler: mi.Sampler, count: int) -> BoundaryPoints:
        """Points of the film boundary, of which `sample` makes samples."""
        outlines, scene = self.outlines, tracer.scene
        with dr.resume_grad():
            at = outlines.placed(sensor)
        with dr.suspend_grad():
            if sensor.needs_aperture_sample():
                at.aperture_sample = sampler.next_2d()
            # Where interpolated normals go on being lit, the shadow of a mesh on itself begins at edges that are
            # silhouettes as seen from a light: that is a jump, too, if the light has no size.
            lights = self.lights.places(scene) if outlines.any_smooth else None
            chosen = outlines.choose(outlines.visible_lengths(at, lights, tracer.shares_directions), sampler, count)
            found = outlines.find(at, chosen)

        # Only here does the gradient enter: the velocity of a point that is fixed on the edge.
        with dr.resume_grad():
            # What is not visible has no place on the film: any point in front of the sensor stands for it, for even
            # with the value zero, a sample at a position that is not finite would spoil a pixel.
            eye = mi.Point3f(at.projection.eye() + at.projection.view())
            p = dr.select(found.valid, outlines.point(at, chosen, found), eye)
            u = at.projection.film(p, at.aperture_sample).position()
            velocity = u - dr.detach(u)

        with dr.suspend_grad():
            n_dl = mi.Vector2f(-found.along_film.y, found.along_film.x) / chosen.density
            if outlines.horizons is not None:
                # From where normals face away to where they do not.
                n_dl = dr.select(chosen.is_horizon, dr.mulsign(n_dl, dr.dot(n_dl, found.facing)), n_dl)
            u, p = dr.detach(u), dr.detach(p)
            active = found.valid & dr.isfinite(dr.squared_norm(n_dl)) & inside_frame(u, sensor.film())
            aside, reach = self._offset(scene, at, p, chosen, found)
            look = partial(self._look, tracer, at, sensor)
            around = aside + reach
            beside, rest, n, n_dl, active = on_grids(outlines, at, look, chosen, found, u, p, n_dl, around, active)
            pair, offset = Beside(tracer, at, sensor, beside, n, sampler), aside + rest * reach
            looked = pair.at(offset, active)
            if outlines.edges is not None:
                looked = pair.clear_of_overhangs(p, offset, looked, active & chosen.is_edge)
            rays, weights, met = looked
            before, sides = None, (rays, met)
            if self.veils:
                slack = BENT * around / at.projection.pixels_per_unit(at.projection.film(p))
                before = Before(p, rounding(p, rays[0].o) + slack, mi.Bool(True))
                go_on = lambda ray, pi: behind_veils(scene, ray, pi, before.veils, active)
                *sides, passed = zip(*map(go_on, rays, met), strict=True)
                # Where only one ray goes through a veil, that ends here, too, and its outline has the whole jump.
                active &= passed[0] == passed[1]
            sides = [list(of) for of in sides]
            active &= self._jumps_between(scene, at, chosen, found, p, n, *sides)
            horizons = self._sides_of_horizons(at, chosen, found, p, *sides)
            n_dl = dr.select(active, n_dl * found.forward, 0)
            shared = outlines.lune(at, chosen, lights)
            if tracer.shares_directions:
                shared = self._shared_directions(chosen, shared, *sides, horizons, active)
            sees = met, weights, active, horizons, shared, before, at.projection.attached, at.aperture_sample
            return BoundaryPoints(beside, n_dl, velocity, rays, *sees)

    def _look(self, tracer: Tracer, at: Placed, sensor: mi.Sensor, u: mi.Point2f, active: mi.Bool) -> tuple:
        """Rays at film positions, and the surfaces that they meet behind veils."""
        lens = mi.Point2f(0.5) if at.aperture_sample is None else at.aperture_sample
        on_film = (u - at.projection.crop_offset) / at.projection.crop_size
        ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, on_film, lens, active)
        return ray, self._on_surface(tracer.scene, ray, tracer.first_hit(ray, active), active)

    # ---------------------- What is on their sides ----------------------

    def _on_surface(self, scene: mi.Scene, ray, pi, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """What camera rays meet behind veils."""
        if self.veils:
            no_grid = lambda si, ray: reduce(operator.and_, [si.shape != mi.ShapePtr(g.inner) for g in grids], True)
            grids = self.outlines.grids
            ray, pi, _ = behind_veils(scene, ray, pi, no_grid, active)
        return pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)

    def _shared_directions(
        self, chosen: Chosen, lune: Lune | None, rays, met, horizons, active: mi.Bool
    ) -> Directions | None:
        """In which directions both sides look for light: of a lune, or of the crease of a matt surface."""
        if self.outlines.matt is None:
            return lune
        active = active & chosen.is_edge & dr.gather(mi.Bool, self.outlines.matt, chosen.edge)
        if horizons[0] is not None:
            active &= horizons[0].side == 0
        crease = Crease.between(rays, met, active)
        return crease if lune is None else LuneOrCrease(lune, crease)

    def _jumps_between(self, scene: mi.Scene, at: Placed, chosen: Chosen, found: Found, p, n, rays, met) -> mi.Bool:
        """Is what jumps between two rays beside the points a jump of theirs, and not of another outline close by?

        p : the points. n : unit normals on the film, from the first ray to the second. met : what the rays meet.
        """
        jumps, outlines, projection = mi.Bool(True), self.outlines, at.projection
        if outlines.edges is not None:
            view = projection.view() if projection.orthographic else None
            eye = projection.eye(at.aperture_sample)
            surfaces = [
                pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, chosen.is_edge)
                for ray, pi in zip(rays, met, strict=True)
            ]
            # A line of a texture may lie along an edge, beyond which is another plane.
            bent = BENT * outlines.beside_texture(at, chosen)
            hidden = outlines.edges.is_hidden(at.positions, chosen.edge, p, eye, view, rays, surfaces, bent)
            # But what both rays meet must be one surface, and not something that stands on it.
            s, t = surfaces
            one = (s.shape == t.shape) & (s.instance == t.instance) & (dr.dot(s.n, t.n) > GOES_ON)
            hidden |= (bent > 0) & ~one
            grids = outlines.edges.grids
            if grids.any:
                of = at.positions, at.normals, chosen.edge, found.t, p
                behind = [self._on_surface(scene, r, pi, chosen.is_edge) for r, pi in zip(rays, met, strict=True)]
                parted = grids.parts(chosen.edge, *(outlines.edges.side_of_crease(*of, si) for si in behind))
                hidden = dr.select(grids.are(chosen.edge), ~parted, hidden)
            jumps &= ~(chosen.is_edge & hidden)
        if outlines.horizons is not None:
            dark = outlines.horizons.sees_dark_side(chosen.face, p, rays[0], met[0], chosen.is_horizon)
            if outlines.horizons.any_grid:
                # What was found about the outline of a grid may be that of another part of it, which hides it.
                si = self._on_surface(scene, rays[0], met[0], chosen.is_horizon)
                own = outlines.horizons.meets_grid(chosen.face, p, found.normal, rays[0], si, before=BESIDE)
                dark = dr.select(outlines.horizons.is_of_grid(chosen.face), own, dark)
            jumps &= ~chosen.is_horizon | dark
        if outlines.curves is not None:
            # Where a rim of a cylinder comes close to its contour, the ray on the side of the wall may pass beyond
            # that: a jump of the contour's, which would count twice.
            c = found.curve
            across = lambda v: dr.dot(projection.tangent(c.p, mi.Point3f(c.p + v), mi.Float(0), at.aperture_sample), n)
            missed = [outlines.curves.misses(at.frames, chosen.piece, ray) for ray in rays]
            jumps &= ~chosen.is_curve | ~dr.select(across(c.inwards) > 0, missed[1], missed[0])
            jumps &= self._is_seen_rim(at, chosen, found, p, rays, met, across)
        return jumps

    def _is_seen_rim(self, at: Placed, chosen: Chosen, found: Found, p, rays, met, across) -> mi.Bool:
        """Is a point of a rim seen, and not another rim, or another part of it, at the same place of the film? All that
        is on no rim counts as seen.

        across : how far a vector from the point goes across the rim on the film.
        """
        c, curves = found.curve, self.outlines.curves
        rim, slack = chosen.is_curve & ~c.slides, self._blur(at, chosen, found) + rounding(p, rays[0].o)
        faces = c.inwards, c.other
        edge_on = [are_edge_on(dr.cross(c.tangent, v), rays[0].d) for v in faces]
        seen, reached = mi.Bool(True), mi.Bool(False)
        for sign, ray, pi in zip((-1, 1), rays, met, strict=True):
            si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, rim)
            through = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Null)
            at_p, nearer = compare_depth(p, ray, si, slack)
            seen &= through | ~nearer
            reached |= through | at_p
            if curves.any_joined:
                # Between rims that coincide, rounding may let a ray through.
                bare = [(sign * across(v) < 0) | on for v, on in zip(faces, edge_on, strict=True)]
                seen &= ~curves.joined(chosen.piece) | at_p | (bare[0] & bare[1])
        return ~rim | (seen & (reached | ~edge_on[0] | ~edge_on[1]))

    def _sides_of_horizons(self, at: Placed, chosen: Chosen, found: Found, p, rays, met) -> list[Horizon | None]:
        """On which side of a horizon of interpolated normals each of two rays is. A contour is such a horizon, too: of
        thin shapes, normals turn much between it and where rays surely meet the shape."""
        horizons, curves = self.outlines.horizons, self.outlines.curves
        if horizons is None and curves is None:
            return [None, None]
        side, reach, on_curve = mi.Float(0), mi.Float(0), chosen.is_horizon
        if horizons is not None and self.outlines.edges is not None:
            # Where a curve runs between the two rays beside an edge, its jump is not that of the edge.
            sight = line_of_sight(p, rays)
            side = self.outlines.edges.facing(at.normals, horizons.sign, chosen.edge, found.t, -sight)
            side = dr.select(chosen.is_edge & self.outlines.edges.is_fold(at.positions, chosen.edge, p, sight), side, 0)
        sides = [dr.select(on_curve, mi.Float(sign), side) for sign in (-1, 1)]
        if horizons is not None and horizons.any_grid:
            # Where smooth normals turn away just inside of an outline, both jumps count as one.
            of_grid = on_curve & horizons.is_of_grid(chosen.face)
            sides, on_curve = [dr.select(of_grid, 1, s) for s in sides], on_curve & ~of_grid
            reach = dr.select(of_grid, 2 * horizons.window(chosen.face)[0], 0)
        if curves is not None:
            contour = chosen.is_curve & found.curve.slides
            si = [
                pi.compute_surface_interaction(r, mi.RayFlags.Minimal, contour) for r, pi in zip(rays, met, strict=True)
            ]
            facing = [-dr.sign(dr.dot(hit.n, ray.d)) for hit, ray in zip(si, rays, strict=True)]
            # What mirrors reflect with that normal, and glass lets through, would start inside of the shape.
            turns = [contour & ((hit.bsdf().flags() & STRAIGHT) == 0) for hit in si]
            sides = [dr.select(contour, dr.select(t, f, 0), s) for t, f, s in zip(turns, facing, sides, strict=True)]
            reach, on_curve = dr.select(contour, 2 * self._blur(at, chosen, found), reach), on_curve | contour
        return [Horizon(s, p, on_curve, reach) for s in sides]

    def _blur(self, at: Placed, chosen: Chosen, found: Found) -> mi.Float:
        """How far beside a curve rays from the sensor may find its shape: scene units."""
        return found.curve.slack + self.outlines.curves.blur(at.frames, chosen.piece, at.projection.eye())

    def _offset(
        self, scene: mi.Scene, at: Placed, p: mi.Point3f, chosen: Chosen, found: Found
    ) -> tuple[mi.Float, mi.Float]:
        """How far beside the edge to look, in pixels: just beyond what single precision can tell apart; and how much
        farther an outline or a crease of a grid may be.

        Farther beside grids, spheres, disks, cylinders and tubes, which rays meet less precisely.
        """
        projection, outlines, ulp = at.projection, self.outlines, dr.epsilon(mi.Float) * 2
        imprecise, farther, reach = chosen.is_curve | chosen.is_cut, mi.Float(0), mi.Float(0)
        if outlines.edges is not None:
            viewer, grids = projection.viewer(at.aperture_sample), outlines.edges.grids
            to_viewer = viewer - p
            if projection.orthographic:
                to_viewer = mi.Vector3f(viewer) * dr.dot(projection.eye() - p, viewer)
            beside_edge = outlines.edges.farther(scene, at.positions, chosen.edge, p, to_viewer)
            farther = dr.select(chosen.is_edge, beside_edge, 0)
            farther += outlines.beside_texture(at, chosen)
            if grids.any:
                reach = dr.select(chosen.is_edge, grids.reach(chosen.edge), 0)
                imprecise |= chosen.is_edge & grids.are(chosen.edge)
        if outlines.horizons is not None and outlines.horizons.any_grid:
            reach = dr.select(chosen.is_horizon, outlines.horizons.window(chosen.face)[0], reach)
            imprecise |= chosen.is_horizon & outlines.horizons.is_of_grid(chosen.face)
        if outlines.curves is not None:
            farther = dr.select(chosen.is_curve, self._blur(at, chosen, found), farther)
        ulps = dr.select(imprecise, 8, 2) * ulp
        largest = dr.maximum(dr.max(dr.abs(p)), dr.max(dr.abs(projection.eye())))
        per_unit = projection.pixels_per_unit(projection.film(p))
        on_film = ulps * max(projection.crop_size + projection.crop_offset)
        return (ulps * largest + farther) * per_unit + on_film, reach * per_unit
