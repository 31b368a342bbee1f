"""Derivative of the light along whole paths, however they were made.

A path from the camera by way of the vertices x_1 … x_n to a light brings the light

    L = F_1 F_2 … F_n / p,        F_j = f(x_j) |cos θ_j| |cos θ_{j+1}| dA_{j+1} / |x_{j+1} − x_j|²,

where the last factor has the radiance of the light, too. Its density p has no derivative, and neither has its weight:
both are those of the sample. So the derivative is that of the product, and with F̂_j = F_j over its present value,

    ∂L = L Σ_j ∂F̂_j .

The factors move as `parametrisation.py` has it, from the camera to the light. That does not depend on how the path was
made: a vertex of a light subpath follows its surface, or slides over it, as if it had been met from the camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.divided_light import DividedLight
from rimlight.edge_sampling.first_points import seen_by_camera
from rimlight.edge_sampling.parametrisation import Slides, Vicinity, shown_by_mirror
from rimlight.edge_sampling.rays import lift, spawn_ray

from .emission import Around
from .found_light import LightEnd
from .paths import Vertex
from .replay import FLAGS, Chain, Start, derivatives, leaves
from .scattering import Scattering
from .vertex_table import VertexTable


@dataclass(frozen=True)
class Part:
    """Vertices of subpaths, of which paths are put together.

    table : of all vertices. lane : mi.UInt32, (N,), which subpath. count : mi.UInt32, how many of its vertices, from
        the first on.
    """

    table: VertexTable
    lane: mi.UInt32
    count: mi.UInt32


class WholePaths:
    """One path of each sample. It is differentiated as `Replay` is: from `start`, by `forward` or `backward`.

    camera, light : its vertices that scatter, from both ends.
    end : where it ends at a light.
    L : mi.Spectrum, its light.
    ray : camera ray, attached to the camera.
    seen : what the ray meets: the first vertex; or the light, if nothing scatters on the way.
    joined : mi.Bool, is the last vertex joined with a point that was sampled on a light?
    slides : see `Vicinity`. lamps : see `Scattering`. around : the scene.
    """

    def __init__(
        self,
        scene: mi.Scene,
        camera: Part,
        light: Part,
        end: LightEnd,
        L: mi.Spectrum,
        ray: mi.RayDifferential3f,
        seen: mi.PreliminaryIntersection3f,
        joined: mi.Bool,
        slides: Slides,
        lamps: DividedLight | None,
        around: Around,
    ):
        self.joined = joined
        self.scene, self.camera, self.light, self.end = scene, camera, light, end
        self.time, self.wavelengths = ray.time, ray.wavelengths
        self.n = camera.count + light.count
        self.radius = around.radius
        self.seen = mi.PreliminaryIntersection3f(seen)
        self.chain = Chain(scene, Vicinity.of(seen, slides), lamps=lamps)
        self.scattering = self.chain.scattering
        self.lamps = lamps
        self.delta = mi.has_flag(end.emitter.flags(), mi.EmitterFlags.Delta)
        self.L = L
        if self.scattering.any_mirror:
            # Mirrors show no light without size: there is nothing that could be held fixed.
            _, _, last = self._place(self.n, self.n > 0)
            self.L = dr.select(last & self.delta, 0, L)
        self.active = dr.any(self.L != 0)
        self._start(ray)

    # ---------------------- Where it goes ----------------------

    def _place(self, k: mi.UInt32, active: mi.Bool):
        """Vertex k, counted from the camera: its point, what is there, and does a mirror send the path on?"""
        own = active & (k <= self.camera.count)
        found = self.camera.table.vertex(self.camera.lane, k, own)
        # The light subpath has them in the opposite order.
        other = self.light.table.vertex(self.light.lane, self.n + 1 - k, active & ~own)
        p, pi, mirrored = (dr.select(own, a, b) for a, b in zip(found, other, strict=True))
        # Where both were joined, the subpaths themselves may have gone on by mirrors.
        joined = (k == self.camera.count) & (self.joined | (self.light.count > 0)) | (k == self.camera.count + 1) & ~own
        return p, pi, mirrored & ~joined

    def _lobe(self, k: mi.UInt32, active: mi.Bool) -> mi.Float:
        """The random number by which a mirror sends the path on from vertex k."""
        own = active & (k <= self.camera.count)
        other = self.light.table.lobe(self.light.lane, self.n + 1 - k, active & ~own)
        return dr.select(own, self.camera.table.lobe(self.camera.lane, k, own), other)

    def _vertex(self, k: mi.UInt32, active: mi.Bool) -> Vertex:
        """Vertex k, as it is met from the one before. Its β is 1."""
        x, before, mirrored = self._place(k - 1, active)
        y, pi, _ = self._place(k, active)
        d = y - x
        t = dr.norm(d)
        active = active & (t > 0)
        d /= dr.select(active, t, 1)
        # A ray from exactly the surface of a ball, through the ball, may be taken for one that ends where it starts.
        beyond = dr.minimum(lift(self.scene, x), 0.5 * t)
        pi.t = dr.select(active, t - beyond, dr.inf)
        pi.valid &= active
        ray = mi.Ray3f(dr.fma(d, beyond, x), d, self.time, self.wavelengths)
        slides = mirrored
        if self.chain.vicinity.glass:
            slides = mirrored | (active & self.chain.vicinity.is_infinite(before.shape.bsdf()))
        return Vertex(ray, pi, k, mi.Spectrum(1), mi.Float(1), mirrored, slides)

    def _light(self, si: mi.SurfaceInteraction3f) -> mi.DirectionSample3f:
        """The light at its end, as a surface sees it. Detached."""
        flags, p = self.end.emitter.flags(), dr.detach(si.p)
        infinite = mi.has_flag(flags, mi.EmitterFlags.Infinite)
        ds = dr.zeros(mi.DirectionSample3f, dr.width(p))
        ds.d = dr.select(infinite, mi.Vector3f(self.end.place), dr.normalize(self.end.place - p))
        ds.p = dr.select(infinite, p + ds.d * (2 * self.radius), self.end.place)
        ds.emitter, ds.pdf, ds.delta = self.end.emitter, mi.Float(1), self.delta
        return ds

    # ---------------------- What it carries ----------------------

    def _start(self, ray: mi.RayDifferential3f) -> None:
        """The first vertex, which the camera ray meets, and what moves the second."""
        si = seen_by_camera(self.scene, ray, self.seen, self.active, attached=True)
        at_light = self.active & (self.n == 0)
        scattering = Scattering(self.scene, attached=True, lamps=self.lamps)
        factor, moving = self._factor(scattering, mi.UInt32(1), si, self.active & ~at_light)
        with dr.resume_grad():
            emitted = si.emitter(self.scene).eval(si, at_light)
            self.start = Start(moving.o, moving.d, dr.select(at_light, relative(emitted), factor))

    def _factor(
        self, scattering: Scattering, k: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Ray3f]:
        """What vertex k does to the light, over its present value; and the ray from there to the next one, as it moves
        with `si`."""
        last, active = active & (k == self.n), active & (k <= self.n)
        bsdf, going = si.bsdf(), active & ~last
        beyond, one = self._vertex(k + 1, going), mi.Float(1)
        ds = self._light(si)
        mirrored = mi.Bool(False)
        if scattering.any_mirror:
            mirrored = self._place(k, active)[2]
        with dr.resume_grad():
            _, _, _, onwards = scattering.throughput(
                si, bsdf, beyond.ray, beyond.pi, one, self.chain.vicinity, going, ~mirrored
            )
            arriving = self._reflected_light(scattering, si, bsdf, ds, last & ~mirrored)
            factor = dr.select(last, arriving, onwards)
            moving = mi.Ray3f(beyond.ray)
            moving.o = dr.replace_grad(beyond.ray.o, si.p)
            if scattering.any_mirror:
                mirrored &= active
                wo, at_mirror = scattering.mirror(si, bsdf, self._lobe(k, mirrored), mi.Point2f(0.5), mirrored)
                at_mirror *= dr.select(last, self._shown_light(si, wo, ds.d, last & mirrored), 1)
                factor = dr.select(mirrored, at_mirror, factor)
                moving.d = dr.replace_grad(beyond.ray.d, dr.select(mirrored, si.to_world(wo), beyond.ray.d))
            return relative(factor), moving

    def _reflected_light(self, scattering: Scattering, si, bsdf, ds, active) -> mi.Spectrum:
        """What arrives from the light, as `si` reflects it."""
        sampled = lambda active: ds.emitter.sample_direction(si, mi.Point2f(0.5), active)
        direction, arriving, visible, to_lamp = scattering.attach_light(si, ds, sampled, active)
        f = bsdf.eval(mi.BSDFContext(), si, si.to_local(direction), active)
        L = dr.select(visible, f * arriving, 0)
        return dr.select(to_lamp.still, dr.detach(L), L)

    def _shown_light(self, si, wo, d: mi.Vector3f, active) -> mi.Spectrum:
        """What a mirror shows of the light: it slides over that."""
        with dr.suspend_grad():
            ray = spawn_ray(self.scene, si, d)
            pi = self.scene.ray_intersect_preliminary(ray, active=active)
        y = shown_by_mirror(self.scene, si, wo, ray, pi, active)
        return y.emitter(self.scene).eval(y, active)

    # ---------------------- Derivatives ----------------------

    def forward(self, start: Start) -> mi.Spectrum:
        """Derivative of the light, detached; given that of the start."""

        def bounce(k, total, δo, δd):
            active = self.active & (k <= self.n)
            vertex = self._vertex(k, active)
            o, d = leaves(vertex.ray.o, vertex.ray.d)
            with dr.resume_grad():
                dr.set_grad(o, δo)
                dr.set_grad(d, δd)
            si = self.chain.surface(vertex, o, d, active)
            factor, moving = self._factor(self.scattering, k, si, active)
            with dr.resume_grad():
                δfactor, δo, δd = derivatives(factor, moving.o, moving.d)
            return k + 1, total + dr.select(active, δfactor, 0), δo, δd

        width = dr.width(self.n)
        _, total, _, _ = dr.while_loop(
            (dr.full(mi.UInt32, 2, width), dr.zeros(mi.Spectrum, width), start.o, start.d),
            lambda k, *_: self.active & (k <= self.n),
            bounce,
            label="derivative of paths",
        )
        return dr.select(self.active, self.L * (start.weight + total), 0)

    def backward(self, δL: mi.Spectrum) -> Start:
        """Propagate the gradient of a loss with respect to the light to the parameters; returns the gradient with
        respect to the start."""
        δ = dr.select(self.active, δL * self.L, 0)

        def bounce(k, δo, δd):
            active = self.active & (k >= 2)
            vertex = self._vertex(k, active)
            o, d = leaves(vertex.ray.o, vertex.ray.d)
            si = self.chain.surface(vertex, o, d, active)
            factor, moving = self._factor(self.scattering, k, si, active)
            with dr.resume_grad():
                value = dr.sum(δ * factor) + dr.dot(δo, moving.o) + dr.dot(δd, moving.d)
                dr.backward_from(dr.select(active, value, 0), flags=FLAGS)
                δo, δd = dr.select(active, dr.grad(o), δo), dr.select(active, dr.grad(d), δd)
            return k - 1, mi.Vector3f(δo), mi.Vector3f(δd)

        zero = mi.Vector3f(dr.zeros(mi.Float, dr.width(self.n)))
        _, δo, δd = dr.while_loop(
            (mi.UInt32(self.n), zero, mi.Vector3f(zero)),
            lambda k, *_: self.active & (k >= 2),
            bounce,
            label="derivative of paths",
        )
        return Start(mi.Point3f(δo), mi.Vector3f(δd), mi.Spectrum(δ))


def relative(x: mi.Spectrum) -> mi.Spectrum:
    """Each component over its present value; 0 where that is 0."""
    now = dr.detach(x)
    there = (now != 0) & dr.isfinite(now)
    return dr.select(there, x / dr.select(there, now, 1), 0)
