"""The derivative of light along paths at fixed samples, and the motion of their vertices.

Each vertex moves with the one before: close to it, it slides over its surface, since there the direction is held
(`edge_sampling/parametrisation.py`). So a path is a chain. In forward mode, the motion is handed on from the first
vertex to the last; in backward mode, gradients go from the last to the first. The path is written down for that, and
visited again from its end (as path replay, Vicini et al. 2021, but with memory in proportion to the path's length).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.choice.light_choice import LightChoice
from rimlight.edge_sampling.divided_light import DividedLight, axis_of
from rimlight.edge_sampling.first_points import FirstPoints, seen_by_camera
from rimlight.edge_sampling.parametrisation import Vicinity, look_from, sliding_point
from rimlight.edge_sampling.refusals import Refusal

from .log import Log
from .paths import Depths, Vertex, as_if_lit, step
from .scattering import Numbers, Scattering, next_vertex

#: Longest path of which a table is made without counting its vertices before.
LONG = 32


@dataclass
class Start:
    """What moves the second vertex of a path. Attached.

    o : mi.Point3f, the first vertex. d : mi.Vector3f, direction from there. weight : mi.Spectrum, throughput.
    """

    o: mi.Point3f
    d: mi.Vector3f
    weight: mi.Spectrum


class Chain:
    """The vertices of paths behind the first, as they move.

    vicinity : in which they slide.
    lights, lamps, brightens : see `Scattering`.
    held : what is held where the camera sees it.
    """

    def __init__(
        self,
        scene: mi.Scene,
        vicinity: Vicinity,
        lights: LightChoice | None = None,
        lamps: DividedLight | None = None,
        held: FirstPoints | None = None,
        *,
        brightens: bool = False,
    ):
        self.scattering = Scattering(scene, attached=True, lights=lights, lamps=lamps, brightens=brightens)
        self.vicinity, self.held = vicinity, held

    def surface(self, vertex: Vertex, o: mi.Point3f, d: mi.Vector3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """The surface at a vertex, attached to the point and the direction from which its ray comes, too."""
        with dr.resume_grad():
            ray = mi.Ray3f(vertex.ray)
            ray.o, ray.d = dr.replace_grad(ray.o, o), dr.replace_grad(ray.d, d)
            far = self.vicinity.far(dr.square(vertex.pi.t))
            si = sliding_point(self.scattering.scene, ray, vertex.pi, dr.select(vertex.slides, 0, far), active)
            if self.scattering.directional:
                look_from(si, ray.o, ray, vertex.pi.t)
            return si

    def along(self, log: Log, depth: mi.UInt32, si: mi.SurfaceInteraction3f, vertex: Vertex, active) -> mi.Ray3f:
        """The ray from a vertex to the next one that was written down, as it moves with the surface."""
        beyond = log.vertex(depth + 1, active)
        ray = mi.Ray3f(beyond.ray)
        ray.o = mi.Point3f(si.p)
        if self.scattering.any_mirror:
            ray.d = self.turned(si, si.bsdf(vertex.ray), beyond, log.numbers(depth, active), active)
        return ray

    def turned(self, si, bsdf, beyond: Vertex, numbers: Numbers, active) -> mi.Vector3f:
        """The direction to the vertex beyond, which turns with `si` if that is a mirror."""
        active = active & beyond.mirrored
        bs, _ = bsdf.sample(mi.BSDFContext(), si, numbers.lobe, numbers.direction, active)
        return dr.select(active, dr.replace_grad(beyond.ray.d, si.to_world(bs.wo)), beyond.ray.d)


def leaves(*values) -> list:
    """Copies that depend on nothing, and carry gradients of their own."""
    with dr.resume_grad():
        values = [dr.detach(v) for v in values]
        dr.enable_grad(values)
        return values


FLAGS = dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad


def derivatives(*values) -> list:
    return [dr.detach(v) for v in dr.forward_to(list(values), flags=FLAGS)]


class Replay:
    """Derivative of `scattered_light` at its fixed samples.

    sampler : in the state in which `scattered_light` would find it.
    vertex : the second of the path.
    start : what moves that.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        vertex: Vertex,
        start: Start,
        vicinity: Vicinity,
        depths: Depths,
        active: mi.Bool,
        lights: LightChoice | None = None,
        lamps: DividedLight | None = None,
        *,
        brightens: bool = False,
    ):
        self.scene, self.sampler, self.vertex, self.start, self.depths = scene, sampler, vertex, start, depths
        self.chain = Chain(scene, vicinity, lights, lamps, brightens=brightens)
        self.active = active & vertex.pi.is_valid() & depths.scatters(vertex.depth)

    def forward(self, start: Start) -> mi.Spectrum:
        """Derivative of the light that arrives by way of the vertex, detached; given that of the start."""
        scattering, depths = self.chain.scattering, self.depths

        def bounce(total, o, d, β, vertex, active, sampler):
            (x, direction) = leaves(vertex.ray.o, vertex.ray.d)
            with dr.resume_grad():
                dr.set_grad(x, o)
                dr.set_grad(direction, d)
            si = self.chain.surface(vertex, x, direction, active)
            direct, onwards = scattering.scatter(
                si, si.bsdf(vertex.ray), scattering.draw(sampler, active), active, self.chain.vicinity
            )
            with dr.resume_grad():
                moving = onwards.moving
                δdirect, δweight, o, d = derivatives(direct, onwards.weight, moving.o, moving.d)
            total += dr.select(active, vertex.β * δdirect + β * dr.detach(direct), 0)
            after, goes_on, more = step(vertex, onwards, sampler, depths, active)
            β = more * (β * dr.detach(onwards.weight) + vertex.β * δweight)
            return total, o, d, β, after, goes_on, sampler

        zero = dr.zeros(mi.Spectrum, dr.width(self.active))
        state = (zero, start.o, start.d, start.weight, self.vertex, self.active, self.sampler.clone())
        return dr.while_loop(state, lambda t, o, d, β, v, active, s: active, bounce, label="path replay")[0]

    def backward(self, δL: mi.Spectrum) -> Start:
        """Propagate the gradient of a loss with respect to the light that arrives by way of the vertex to the
        parameters; returns the gradient with respect to the start."""
        log, last = written(self.scene, self.vertex.ray, 2, self.depths, self._follow, lambda last: last)
        chain, scattering = self.chain, self.chain.scattering

        def bounce(depth, L, lit, δo, δd):
            active = self.active & (depth >= 2)
            vertex, beyond = log.vertex(depth, active), log.vertex(depth + 1, active)
            o, d = leaves(vertex.ray.o, vertex.ray.d)
            si = chain.surface(vertex, o, d, active)
            numbers = log.numbers(depth, active)
            vertex.β, vertex.lit = log.throughput(depth, active)
            direct, onwards = scattering.scatter(
                si, si.bsdf(vertex.ray), numbers, active, chain.vicinity, dr.detach(beyond.pi)
            )
            with dr.resume_grad():
                # What comes from farther on, and is more because other paths have ended.
                # (Throughputs are negative where a fit has made a reflectance so.)
                now = dr.sum(dr.abs(as_if_lit(vertex, dr.detach(onwards.weight))))
                more = dr.select(now > 0, dr.sum(dr.abs(lit)) / dr.select(now > 0, now, 1), 0)
                arriving, moving = direct + onwards.weight * (more * L), onwards.moving
                value = dr.sum(δL * vertex.β * arriving) + dr.dot(δo, moving.o) + dr.dot(δd, moving.d)
                dr.backward_from(dr.select(active, value, 0), flags=FLAGS)
                δo, δd = dr.select(active, dr.grad(o), δo), dr.select(active, dr.grad(d), δd)
            L, lit = (dr.select(active, *pair) for pair in ((dr.detach(arriving), L), (vertex.lit, lit)))
            return depth - 1, L, lit, δo, δd

        width = dr.width(self.active)
        zero = mi.Vector3f(dr.zeros(mi.Float, width))
        dark = dr.zeros(mi.Spectrum, width)
        _, L, _, δo, δd = dr.while_loop(
            (last, dark, mi.Spectrum(dark), zero, mi.Vector3f(zero)),
            lambda depth, *_: self.active & (depth >= 2),
            bounce,
            label="path replay",
        )
        # Of exactly these types: `dr.set_grad` passes over others, without a word.
        return Start(mi.Point3f(δo), mi.Vector3f(δd), mi.Spectrum(δL * L))

    def _follow(self, log: Log | None) -> mi.UInt32:
        """Write the paths down; returns the number of the last vertex of each that scatters, 0 if there is none."""
        scattering, scene = self.chain.scattering, self.scene
        if log is not None:
            if self.vertex.lit is not None:
                log.make_room_for_lit()
            log.arrive(self.vertex.depth, self.vertex, self.active)

        def bounce(last, vertex, active, sampler):
            si = vertex.pi.compute_surface_interaction(vertex.ray, mi.RayFlags.All, active)
            numbers = scattering.draw(sampler, active)
            bsdf = si.bsdf(vertex.ray)
            there = scattering.directions_of(si, bsdf, active)
            of_chain = {"directions": there, "brightens": scattering.brightens}
            _, onwards = next_vertex(scene, si, bsdf, numbers, active, self.chain.vicinity, **of_chain)
            if log is not None:
                log.leave(vertex.depth, vertex.β, numbers, active, vertex.lit)
                log.arrive(vertex.depth + 1, onwards, active)
            last = dr.select(active, vertex.depth, last)
            vertex, active, _ = step(vertex, onwards, sampler, self.depths, active)
            return last, vertex, active, sampler

        state = (dr.zeros(mi.UInt32, dr.width(self.active)), self.vertex, self.active, self.sampler.clone())
        return dr.while_loop(state, lambda last, v, active, s: active, bounce, label="paths")[0]


class MovingVertex:
    """One vertex of each path, as it moves. `p` and `n`, its position and the normal of its surface, carry gradients of
    their own; in forward mode those of the chain, in backward mode `backward` hands them on.

    ray : camera rays, attached to the camera.
    first : the vertex that they meet.
    log : the path up to it; and one vertex more, if `onwards`.
    vertex, active : the vertex of each path, and is there one? since : see `Choice`.
    onwards : is the direction to the vertex beyond wanted, too? It is `d`, with gradients of its own.
    lamps : see `Chain`. With the lobes of the vertices, directions are `turning`, with gradients of their own.
    before : as `since`, of the vertex before, which looks at this one. Only needed with `lamps`.
    at_first : the surface at the first vertex, as it moves, if `ray` is none of the camera's; the log begins behind it.
    """

    def __init__(
        self,
        chain: Chain,
        ray: mi.Ray3f,
        first: Vertex,
        log: Log,
        vertex: Vertex,
        active: mi.Bool,
        since: mi.UInt32,
        mode: dr.ADMode,
        *,
        onwards: bool = False,
        lamps: DividedLight | None = None,
        before: mi.UInt32 | None = None,
        at_first: mi.SurfaceInteraction3f | None = None,
    ):
        self.chain, self.first, self.log, self.vicinity = chain, first, log, chain.vicinity
        self.vertex, self.active, self.since = vertex, active, since
        self.depth = mi.UInt32(vertex.depth)
        #: Up to which vertex there is a ray to it.
        self._last = self.depth + 1 if onwards else self.depth
        self._start(ray, at_first)
        at_first = self.depth == 1
        with dr.suspend_grad():
            other = vertex.pi.compute_surface_interaction(vertex.ray, mi.RayFlags.All, active)
            self.si = dr.select(at_first, dr.detach(self.at_first), other)
            beyond = log.vertex(self._last, active).ray.d
            turning = None if lamps is None else lamps.turning(self.si, self.si.bsdf(), active)
            #: Do lobes turn? Then it matters from where a vertex is looked at, though it does not slide.
            self._turns = turning is not None
            if turning is not None:
                self.since = dr.select(turning.anywhere & ~at_first, before, since)
        axis = turning.axis if turning is not None else mi.Vector3f(0)
        self.p, self.n, self.d, axis = self.leaves = leaves(self.si.p, self.si.n, beyond, axis)
        with dr.resume_grad():
            self.si.p, self.si.n = self.p, self.n
            self.turning = turning and replace(turning, axis=axis)
            if mode == dr.ADMode.Forward:
                first = self.at_first
                here = derivatives(first.p, first.n, self.start.o, self.start.d, self._axis(first))
                δp, δn, δo, δd, δaxis = here
                # Not to be kept: Dr.Jit 1.5 refuses to pass it by in the loop.
                self.at_first = self.start = first = None
                for leaf, δ, later in zip(self.leaves, (δp, δn, δd, δaxis), self._forward(δo, δd), strict=True):
                    dr.set_grad(leaf, dr.select(at_first, mi.Vector3f(δ), later))

    def _start(self, ray: mi.Ray3f, si: mi.SurfaceInteraction3f | None) -> None:
        """The first vertex, and what moves the second."""
        scene, pi, known = self.chain.scattering.scene, self.first.pi, si is not None
        if not known:
            si = seen_by_camera(scene, ray, pi, self.active, attached=True, held=self.chain.held)
        self.at_first = si
        active = self.active & (self._last > 1)
        second = self.log.vertex(dr.full(mi.UInt32, 2, dr.width(self.depth)), active)
        d = second.ray.d
        if self.chain.scattering.any_mirror and not known:
            with dr.resume_grad():
                numbers = self.log.numbers(self.first.depth, active)
                d = self.chain.turned(si, si.bsdf(ray), second, numbers, active)
        with dr.resume_grad():
            self.start = Start(mi.Point3f(si.p), d, mi.Spectrum(1))

    def _axis(self, si: mi.SurfaceInteraction3f) -> mi.Vector3f:
        """With what directions turn there, attached."""
        return axis_of(si) if self._turns else mi.Vector3f(0)

    def _forward(self, δo: mi.Point3f, δd: mi.Vector3f) -> list[mi.Vector3f]:
        """Derivatives of position, normal, direction onwards, and axis, where it is not the first."""
        chain, log = self.chain, self.log

        def bounce(depth, p, n, o, d, axis):
            active = self.active & (depth <= self.depth)
            vertex = log.vertex(depth, active)
            x, direction = leaves(vertex.ray.o, vertex.ray.d)
            with dr.resume_grad():
                dr.set_grad(x, o)
                dr.set_grad(direction, d)
            si = chain.surface(vertex, x, direction, active)
            with dr.resume_grad():
                moving = chain.along(log, depth, si, vertex, active & (depth < self._last))
                # With all that parameters of the mesh change: Dr.Jit 1.5 refuses to leave any of it out.
                follow = si.p, si.n, moving.o, moving.d, self._axis(si), si.uv, si.sh_frame.n
                found = derivatives(*follow)[:5]
            return depth + 1, *(mi.Vector3f(v) for v in found)

        zero = mi.Vector3f(dr.zeros(mi.Float, dr.width(self.depth)))
        # A vertex that does not slide knows nothing of those before.
        first, chained = dr.maximum(self.since, 2), self.since == 1
        _, p, n, _, d, axis = dr.while_loop(
            (
                first,
                mi.Vector3f(zero),
                mi.Vector3f(zero),
                dr.select(chained, mi.Vector3f(δo), 0),
                dr.select(chained, mi.Vector3f(δd), 0),
                mi.Vector3f(zero),
            ),
            lambda depth, *_: self.active & (depth <= self.depth),
            bounce,
            label="motion of a vertex",
        )
        return [p, n, d, axis]

    @property
    def gradients(self) -> list:
        """What `backward` hands on."""
        return [dr.grad(leaf) for leaf in self.leaves]

    def backward(self) -> None:
        """Hand the gradients on to the surfaces, and to the camera rays."""
        chain, log = self.chain, self.log
        δp, δn, δd, δaxis = self.gradients
        dr.eval(δp, δn, δd, δaxis)

        def bounce(depth, δp, δn, δd, δaxis):
            active = self.active & (depth >= dr.maximum(self.since, 2))
            vertex = log.vertex(depth, active)
            o, d = leaves(vertex.ray.o, vertex.ray.d)
            si = chain.surface(vertex, o, d, active)
            with dr.resume_grad():
                moving = chain.along(log, depth, si, vertex, active & (depth < self._last))
                value = dr.dot(δp, moving.o) + dr.dot(δn, si.n) + dr.dot(δd, moving.d)
                value += dr.dot(δaxis, self._axis(si))
                dr.backward_from(dr.select(active, value, 0), flags=FLAGS)
                δo, δd = dr.grad(o), dr.grad(d)
            return depth - 1, mi.Vector3f(δo), mi.Vector3f(0), δd, mi.Vector3f(0)

        with dr.suspend_grad():
            at_first = self.depth == 1
            later = lambda g: dr.select(at_first, 0, mi.Vector3f(g))
            _, δo, _, to_first, _ = dr.while_loop(
                (mi.UInt32(self.depth), later(δp), later(δn), later(δd), later(δaxis)),
                lambda depth, *_: self.active & (depth >= dr.maximum(self.since, 2)),
                bounce,
                label="motion of a vertex",
            )
        with dr.resume_grad():
            si, start = self.at_first, self.start
            value = dr.dot(dr.select(at_first, δp, 0), si.p) + dr.dot(dr.select(at_first, δn, 0), si.n)
            value += dr.dot(dr.select(at_first, δaxis, 0), self._axis(si))
            to_first = dr.select(at_first, mi.Vector3f(δd), to_first)
            chained = self.active & (self._last > 1) & (self.since == 1)
            value += dr.select(chained & ~at_first, dr.dot(δo, start.o), 0)
            value += dr.select(chained, dr.dot(to_first, start.d), 0)
            dr.backward_from(value, flags=FLAGS)


def written(
    scene: mi.Scene,
    like: mi.Ray3f,
    first: int,
    depths: Depths,
    follow: Callable[[Log | None], Any],
    last_of: Callable[[Any], mi.UInt32],
) -> tuple[Log, Any]:
    """Paths, written down from their vertex number `first` on; and what `follow` returns, which goes along them.

    like : see `Log`. last_of : number of the last vertex of each path, by what `follow` returns.

    Raises
    ------
    RuntimeError : paths have no limit, while `dr.freeze` records.
    """
    last = depths.max_depth
    if last > LONG:
        if dr.flag(dr.JitFlag.FreezingScope):
            raise Refusal(f'a frozen function cannot count the vertices of paths: set "max_depth" to at most {LONG}')
        last = 2 + int(dr.max(last_of(follow(None)))[0])
    log = Log(scene, like, first, last)
    found = follow(log)
    # All at once: what is not evaluated now would follow the paths again when it is.
    dr.eval(found)
    log.close()
    return log, found
