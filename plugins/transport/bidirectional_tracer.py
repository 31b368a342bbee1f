"""The tracer of `bdpt_edge`: it finds paths from both ends."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.boundaries.crease import Directions
from rimlight.edge_sampling.boundaries.horizon import Horizon, turn_to_side, turn_to_viewer
from rimlight.edge_sampling.boundaries.tracer import Sender
from rimlight.edge_sampling.boundaries.veils import Before

from .bidirectional import CameraPaths
from .emission import Around, Emission
from .film_views import FilmViews
from .found_light import LightEnd, OnePath, Seen, Total, Way
from .light_subpaths import LightSubpaths, LightVertex, Ways, light_towards
from .paths import Vertex
from .subpath_weights import Shorter, weight
from .tracer import PathTracer, Radiance, camera_vertex
from .vertex_table import VertexTable
from .whole_paths import Part, WholePaths

#: Sine of the angle between interpolated normal and face from which a surface is taken to send light to both sides.
BENT = 1e-4


class KeepOne:
    """Of what the sensor sees of a light subpath, one vertex, in proportion to its light."""

    def nothing(self, count: int) -> OnePath:
        return OnePath(dr.zeros(mi.Spectrum, count), dr.zeros(mi.Float, count), dr.zeros(Seen, count))

    def add(self, known: OnePath, seen: Seen, L: mi.Spectrum, sampler: mi.Sampler, active: mi.Bool) -> OnePath:
        return known.add(L, seen, sampler, active)


@dataclass(frozen=True)
class FoundPaths:
    """One path of each camera subpath, and one of each light subpath, with all vertices.

    pi : what camera rays meet.
    from_camera, from_light : paths that are kept. camera, light : tables of vertices.
    ends : where light subpaths start. numbers : of the vertices that light subpaths have kept.
    """

    pi: mi.PreliminaryIntersection3f
    from_camera: OnePath
    from_light: OnePath
    camera: VertexTable
    light: VertexTable
    ends: LightEnd
    numbers: mi.UInt32


class BidirectionalTracer(PathTracer):
    """Traces paths from both ends. integrator : tells `light_paths`, too.

    light_sampler : for the light subpaths with which the sides of boundaries are connected, one for each sample of it.
    around : the scene.
    """

    #: Light is looked for by connections, too.
    shares_directions = False

    light_sampler: mi.Sampler | None = None
    around: Around | None = None

    def __init__(self, scene: mi.Scene, integrator: mi.ad.common.ADIntegrator):
        super().__init__(scene, integrator)
        self.light_paths: float = integrator.light_paths

    # ---------------------- The sides of boundaries ----------------------

    # What comes from a lune is found by path tracing: its directions are not those of the BSDF. So is what veils before
    # an outline let through.

    def radiance(
        self,
        ray: mi.Ray3f,
        sampler: mi.Sampler,
        active: mi.Bool,
        *,
        attached: bool,
        horizon: Horizon | None = None,
        directions: Directions | None = None,
        pi: mi.PreliminaryIntersection3f | None = None,
        before: Before | None = None,
    ) -> Radiance:
        if attached:
            return super().radiance(ray, sampler, active, attached=True, horizon=horizon, directions=directions, pi=pi)
        pi = self.first_hit(ray, active) if pi is None else pi

        def turn(si, ray, active):
            if horizon is not None:
                turn_to_side(si, ray, horizon)
            if self.fine_mirrors is not None:
                self.fine_mirrors.turn(si, ray, active)

        by_path = active & directions.active if directions is not None else None
        if before is not None:
            veiled = active & before.veils(pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active), ray)
            by_path = veiled if by_path is None else by_path | veiled
        others = active & ~by_path if by_path is not None else active
        found = self._connected(camera_vertex(ray, pi), sampler.clone(), others, turn, shines=True)
        L, valid = found[0], found[1] | (others & (self.scene.environment() is not None and not self.hide_emitters))
        if by_path is not None:
            options = {"horizon": horizon, "directions": directions, "pi": pi, "before": before}
            other = super().radiance(ray, sampler, by_path, attached=False, **options)
            L, valid = dr.select(by_path, other.L, L), valid | (by_path & other.valid)
        return Radiance(L, valid)

    def scattered(
        self, ray, pi, depth, sampler, active, beside_outline=None, directions=None, found=None, horizon=None
    ) -> mi.Spectrum:
        by_path = active & directions.active if directions is not None else None
        others = active & ~by_path if by_path is not None else active

        def turn(si, ray, active):
            if beside_outline is not None:
                turn_to_viewer(si, ray, active & beside_outline)
            if horizon is not None:
                turn_to_side(si, ray, horizon, active)
            if self.fine_mirrors is not None:
                self.fine_mirrors.turn(si, ray, active)

        vertex = camera_vertex(ray, pi)
        vertex.depth = depth + 1
        shorter = None
        if found is not None:
            # In another way, it is found as a vertex of a light subpath: `DeepShadows`.
            y = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, others)
            one = dr.abs_dot(y.n, ray.d) / (found * dr.square(pi.t))
            shorter = Shorter(dr.select((found > 0) & dr.isfinite(one), one, 0), dr.zeros(mi.Float, dr.width(one)))
        L, _ = self._connected(vertex, sampler.clone(), others & pi.is_valid(), turn, shines=False, shorter=shorter)
        if by_path is not None:
            other = super().scattered(ray, pi, depth, sampler, by_path, beside_outline, directions)
            L = dr.select(by_path, other, L)
        return L

    def arriving(
        self, vertex: Vertex, sampler: mi.Sampler, active: mi.Bool, beside_outline: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Bool]:
        def turn(si, ray, active):
            turn_to_viewer(si, ray, active & beside_outline)
            if self.fine_mirrors is not None:
                self.fine_mirrors.turn(si, ray, active)

        return self._connected(vertex, sampler, active, turn, shines=True)

    # ---------------------- Shadows in light from surfaces ----------------------

    def sender(self, count: int, depth: mi.UInt32, active: mi.Bool) -> Sender:
        light = self._lights[2]
        vertex = dr.gather(LightVertex, light, dr.arange(mi.UInt32, count) % dr.width(light.number), active)
        active = active & (vertex.number > 0) & self.depths.scatters(depth + vertex.number)
        si = vertex.pi.compute_surface_interaction(vertex.ray, mi.RayFlags.All, active)
        through = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Transmission)
        # Behind its plane, interpolated normals may send light, too.
        through |= dr.norm(dr.cross(si.n, si.sh_frame.n)) > BENT
        facing = dr.select(through, 0, dr.mulsign(mi.Vector3f(si.n), -dr.dot(si.n, vertex.d)))
        return Sender(si, vertex.β, vertex.one, vertex.more, facing, through, active)

    def sent(self, sender: Sender, d: mi.Vector3f, found: mi.Float, active: mi.Bool) -> mi.Spectrum:
        shorter = Shorter(sender.one, sender.more)
        there = light_towards(sender.si, sender.si.bsdf(), shorter, d, active)
        return there.f * sender.power * weight(found * there.shorter)

    def _connected(
        self, vertex: Vertex, sampler, active, turn, *, shines: bool, shorter: Shorter | None = None
    ) -> tuple[mi.Spectrum, mi.Bool]:
        """Light that arrives by way of a vertex, with connections, without its β; see `CameraPaths.trace`."""
        emission, ways, light = self._lights
        camera = CameraPaths(self.scene, emission, self.depths, ways, hide_emitters=self.hide_emitters)
        total = Total(dr.zeros(mi.Spectrum, dr.width(vertex.depth)))
        got, stopped = camera.trace(vertex, shorter, sampler, light, total, active, turn=turn, shines=shines)
        return got.L, stopped

    @cached_property
    def _lights(self) -> tuple[Emission, Ways, LightVertex]:
        """One vertex of each light subpath. Many samples share one, and both sides of a boundary do."""
        emission, ways = Emission(self.scene, self.around), Ways()
        count, no_views = self.light_sampler.wavefront_size(), FilmViews.none()
        subpaths = LightSubpaths(self.scene, emission, self.depths, ways, hide_emitters=self.hide_emitters)
        kept, *_ = subpaths.trace(self.light_sampler, count, mi.Float(0), no_views, KeepOne())
        return emission, ways, kept

    # ---------------------- The interior ----------------------

    def find_paths(
        self,
        sensor: mi.Sensor,
        ray: mi.Ray3f,
        u: mi.Point2f,
        sampler: mi.Sampler,
        light_sampler: mi.Sampler,
    ) -> FoundPaths:
        """Subpaths from the camera and from the lights, and one path of each: values only.

        ray : camera rays. u : their film positions, pixels. light_sampler : for light subpaths.
        """
        scene, depths, hides = self.scene, self.depths, self.hide_emitters
        count, lights = dr.width(u), light_sampler.wavefront_size()
        longest = max(depths.max_depth - 1, 1)
        emission, ways = Emission(scene, self.around), Ways()
        views = FilmViews(sensor, count // sampler.sample_count(), lights / count)
        light_table, table = VertexTable(scene, lights, longest), VertexTable(scene, count, longest)
        subpaths = LightSubpaths(scene, emission, depths, ways, hide_emitters=hides)
        vertices, ends, seen = subpaths.trace(
            light_sampler, lights, sensor.shutter_open(), views, KeepOne(), light_table
        )
        pi = self.first_hit(ray, True)
        got = OnePath(dr.zeros(mi.Spectrum, count), dr.zeros(mi.Float, count), dr.zeros(Way, count))
        camera = CameraPaths(scene, emission, depths, ways, hide_emitters=hides)
        first, shorter = camera.from_camera(ray, pi, u, views)
        got, _ = camera.trace(first, shorter, sampler, vertices, got, mi.Bool(True), table=table)
        dr.eval(got, pi, vertices.number)
        table.close()
        light_table.close()
        ends = dr.zeros(LightEnd, lights) if ends is None else ends
        return FoundPaths(pi, got, seen, table, light_table, ends, vertices.number)

    def camera_paths(self, found: FoundPaths, ray: mi.RayDifferential3f) -> WholePaths:
        """What camera subpaths have kept. ray : camera rays, attached to the camera."""
        way = found.from_camera.way
        lane = dr.arange(mi.UInt32, dr.width(way.scatters))
        subpath = lane % dr.width(found.numbers)
        number = dr.gather(mi.UInt32, found.numbers, subpath, way.connected)
        start = dr.gather(LightEnd, found.ends, subpath, way.connected)
        camera, light = Part(found.camera, lane, way.scatters), Part(found.light, subpath, number)
        end = dr.select(way.connected, start, way.end)
        L = found.from_camera.standing_for_all
        held = self.slides, self.lamps
        return WholePaths(self.scene, camera, light, end, L, ray, found.pi, way.sampled, *held, self.around)

    def light_paths_seen(self, found: FoundPaths, ray: mi.RayDifferential3f) -> WholePaths:
        """What the sensor sees of light subpaths. ray : the camera rays there, attached to the camera."""
        seen = found.from_light.way
        lane = dr.arange(mi.UInt32, dr.width(seen.number))
        L = found.from_light.standing_for_all
        p, pi, _ = found.light.vertex(lane, seen.number, dr.any(L != 0))
        pi.t = dr.select(pi.valid, dr.norm(p - dr.detach(ray.o)), dr.inf)
        no = mi.Bool(False)
        nothing = Part(found.camera, mi.UInt32(0), dr.zeros(mi.UInt32, dr.width(lane)))
        light = Part(found.light, lane, seen.number)
        held = self.slides, self.lamps
        return WholePaths(self.scene, nothing, light, found.ends, L, ray, pi, no, *held, self.around)
