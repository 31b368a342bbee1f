"""The search for the boundaries of a scene, and how long what it found can be kept."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight._collection import collect_before
from rimlight._plan import listed, names
from rimlight.edge_sampling import (
    Cracks,
    CutCurves,
    DeepShadows,
    Edges,
    FacePlanes,
    FilmBoundary,
    Geometry,
    IndirectBeams,
    IndirectShadows,
    Intersections,
    Lights,
    Rims,
    ShadingBoundary,
    ShadowBoundary,
    Silhouettes,
    Sources,
    TextureLines,
    close_cracks,
    find_welded_edges,
    objects_below,
)
from rimlight.edge_sampling.boundaries.fine_mirrors import FineMirrors
from rimlight.edge_sampling.boundaries.found import Boundaries
from rimlight.edge_sampling.boundaries.horizons_at_points import HorizonsAtPoints
from rimlight.edge_sampling.boundaries.lamp_planes import LampPlanes
from rimlight.edge_sampling.boundaries.shown_shadows import ShownShadows
from rimlight.edge_sampling.boundaries.veils import has_veils
from rimlight.edge_sampling.choice.light_choice import LightChoice
from rimlight.edge_sampling.divided_light import DividedLight
from rimlight.edge_sampling.fine_textures import Looks, fine_textures
from rimlight.edge_sampling.first_points import HeldShapes, can_hold, has_points
from rimlight.edge_sampling.geometry.grids import Grids
from rimlight.edge_sampling.geometry.instances import Instances, is_flat
from rimlight.edge_sampling.geometry.interpolated import normals_turn, texture_slides
from rimlight.edge_sampling.geometry.mapped_horizons import MappedHorizon, mapped_horizons
from rimlight.edge_sampling.geometry.meshes import inner, lets_rays_through, surfaces
from rimlight.edge_sampling.geometry.parameters import Parameter, may_brighten, parameters
from rimlight.edge_sampling.geometry.surfaces import Surfaces
from rimlight.edge_sampling.geometry.texture_edges import TextureEdges
from rimlight.edge_sampling.geometry.texture_lines import looked_at_once
from rimlight.edge_sampling.parametrisation import Slides, slides_behind_glass
from rimlight.edge_sampling.refusals import Refusal
from rimlight.edge_sampling.turning_lobes import is_curved, turning_lobes
from rimlight.transport.film_chains import is_mapped_mirror
from rimlight.transport.paths import Depths

from ._clipping import cut_by_clipping_planes
from ._coarse_limits import FRINGE
from ._limits import Media, Moving, PartialParameters, is_mirror, lasting_limits, refuse_timed_sky

#: Parameters of a light that move the shadows in it, or the border of its beam.
PLACE_OF_LIGHT = ("position", "to_world", "directions", "angular_radius", "sun_direction", "cutoff_angle")

#: Sensors at most of which it is remembered what their clipping planes cut. Each of them keeps its film in memory.
SENSORS = 16


class BoundarySearch:
    """Finds the boundaries that can contribute to a derivative. Edges are kept as long as what they were derived from
    stays as it was (`Sources`), and boundaries besides for each answer to the question what moves.

    Parameters
    ----------
    who : name of the integrator, for messages.
    depths : of its paths.
    planes : does its derivative have what the planes of faces do to soft light, where other normals shade?
    from_points : does it have boundaries as shading points see them?
    from_surfaces : and as vertices of light subpaths see them?
    """

    #: Nothing, for `dr.freeze`: what a frozen function depends on is what `find_boundaries` returns to it.
    DRJIT_STRUCT = dict.fromkeys(())

    def __init__(self, who: str, depths: Depths, *, planes: bool, from_points: bool, from_surfaces: bool):
        self.who, self.depths, self.planes = who, depths, planes
        #: May points of fine textures, and of polished curved shapes, be held, as the first sensor sees them?
        self.holds = False
        self.from_points, self.from_surfaces = from_points, from_surfaces
        self.geometry: Geometry | None = None
        self.edges: Edges | None = None
        self._cracks = Cracks.none()
        self._instances, self._grids = Instances(), Grids()
        self._curves: CutCurves | None = None
        self._rims: Rims | None = None
        self._lines: Intersections | None = None
        self._textures: TextureEdges | None = None
        self._sources: Sources | None = None
        self._checked = False
        self._partial: PartialParameters | None = None
        self._media: Media | None = None
        self._maps: list[MappedHorizon] = []
        #: Shapes with materials that may come to throw rays in other directions: those that know of `turns`.
        self._bent: list[tuple[mi.Shape, mi.BSDF]] = []
        self._beyond: dict[tuple, tuple[mi.Sensor, list[str]]] = {}
        self._boundaries: dict[tuple, Boundaries] = {}
        #: What is held, and at which look at the textures that was found.
        self._fine: dict[tuple, tuple[int, HeldShapes | None]] = {}
        self._looks = Looks()

    def prepare(self, scene: mi.Scene, sensor: mi.Sensor, sppi: int) -> Boundaries:
        """Find them for a frozen function, which is to be called next, and cannot look for itself."""
        boundaries = self.boundaries(scene, sensor, sppi)
        self._checked = True
        return boundaries

    @looked_at_once()
    def boundaries(self, scene: mi.Scene, sensor: mi.Sensor, sppi: int) -> Boundaries:
        """The boundaries that can contribute to a derivative with respect to the parameters that carry a gradient now.

        sppi : samples per pixel of the boundaries at shading points.
        """
        geometry, found = self._grids.geometry(self._instances.geometry(scene)), parameters(scene)
        self._renew(scene, found, geometry)
        with dr.resume_grad():
            self._media.refuse_gradients(self.who)
            limits = (*self._media.limits(), *self._partial.limits())
            changing = [p for p in found if dr.grad_enabled(p.value)]
            self._refuse_moving_others(geometry, changing)
            moving = self._what_moves(scene, sensor, geometry, changing)
        brightens = any(may_brighten(p) for p in changing)
        if not moving.anything:
            return Boundaries(limits=limits, brightens=brightens)
        if not dr.flag(dr.JitFlag.FreezingScope):
            self._find_lines(scene)
            self._looks.at(found)
        if not self._checked:
            # A frozen function cannot look at arrays: its `state_fn` must have done so, just before.
            self._refuse_while_recording()
        held = self._held(scene, sensor, moving)
        key = (*moving.key, sppi > 0, self.depths, held)
        if key not in self._boundaries:
            self._refuse_while_recording()
            self._boundaries[key] = self._find(scene, sensor, moving, sppi, held)
        boundaries = self._boundaries[key]
        if boundaries.shading is not None and not dr.flag(dr.JitFlag.FreezingScope):
            boundaries.shading.boxes.find_shapes()
        if self.depths.scatters(2) and any(
            p.node.class_name() == "SDFGrid" and p.name.endswith("grid") for p in changing
        ):
            boundaries = replace(boundaries, slides=Slides.EVERYTHING)
        limits += (*boundaries.limits, *self._limits_of_sensor(sensor, moving))
        if limits == boundaries.limits and not brightens:
            return boundaries
        return replace(boundaries, limits=limits, brightens=brightens)

    # ---------------------- Edges ----------------------

    def _renew(self, scene: mi.Scene, found: list[Parameter], geometry: Geometry) -> None:
        """Find the edges, if what they were derived from is no longer the same."""
        same = self._sources is not None and self._sources.same_objects(scene, found, geometry)
        if not dr.flag(dr.JitFlag.FreezingScope):
            same, self._checked = same and self._sources.same_content(geometry), False
        if same:
            return
        self._refuse_while_recording()
        refuse_timed_sky(scene, self.who)
        # The scene before may be garbage by now. Nothing is traced yet, and `dr.freeze` may be about to record.
        self.geometry = self.edges = self._curves = self._rims = self._lines = self._textures = None
        self._sources = self._partial = self._media = None
        self._boundaries, self._fine, self._beyond, self._maps, self._bent = {}, {}, {}, [], []
        self._looks = Looks()
        collect_before()
        self.geometry = geometry
        self.edges, weld = find_welded_edges(geometry)
        self._curves, self._rims = CutCurves(geometry), Rims(geometry)
        self._lines = Intersections(scene, geometry, self.edges, weld)
        self._textures = TextureEdges(geometry, every=has_veils(scene))
        self.edges, self._cracks = close_cracks(geometry, self.edges, weld)
        self._sources = Sources(scene, found, geometry, self.edges, weld, self._cracks)
        self._partial, self._media = PartialParameters(scene), Media(scene)
        self._maps = [m for s in surfaces(scene) for m in mapped_horizons(s)]
        self._bent = [(s, o) for s in surfaces(scene) for o in objects_below(s).values() if hasattr(o, "turns")]

    def _find_lines(self, scene: mi.Scene) -> None:
        """Find the lines in which the shapes cut through each other now, and the rims that coincide."""
        cut = self._curves.find(self.geometry), self._lines.find(scene, self.geometry)
        changed = *cut, self._rims.find(), self.from_points and self._textures.find()
        if any(changed):
            lines = tuple(lines for lines in (self._curves, self._lines) if lines.capacity)
            self.geometry = replace(self.geometry, lines=lines, joints=self._rims.joints)
            self._boundaries = {}
            collect_before()

    def _edges_of(self, geometry: Geometry) -> Edges:
        """All edges, in the order that `Silhouettes` wants."""
        edges, count = self.edges, sum(m.vertex_count() for m in geometry.meshes)
        if geometry.textures is not None:
            edges += geometry.textures.as_edges(geometry.first_of_textures)
        for lines in geometry.lines:
            edges, count = lines.as_edges(edges, count), count + lines.vertices
        return edges

    def _refuse_while_recording(self) -> None:
        if dr.flag(dr.JitFlag.FreezingScope):
            raise Refusal(
                f"{self.who}: a frozen function cannot find the edges. Let it do so before: "
                "`@dr.freeze(state_fn=lambda scene, integrator, *_: integrator.find_boundaries(scene))`."
            )

    # ---------------------- What moves ----------------------

    def _what_moves(self, scene: mi.Scene, sensor: mi.Sensor, geometry: Geometry, changing: list[Parameter]) -> Moving:
        moves = geometry.moving()
        # To traverse takes long in a step of milliseconds: not where shapes alone change.
        only_shapes = all(isinstance(p.node, mi.Shape) for p in changing)
        still = only_shapes and any(s is sensor for s in scene.sensors())
        camera = not still and any(dr.grad_enabled(value) for _, value in mi.traverse(sensor).items())
        if camera and geometry.others:
            names = ", ".join(f'"{s.id()}" ({s.class_name()})' for s in geometry.others)
            raise Refusal(
                f"{self.who}: the camera moves past {names}, whose silhouettes cannot be sampled yet. "
                "Replace them by meshes."
            )
        shapes = geometry.known
        lamps = any(s.is_emitter() and m for s, m in zip(shapes, moves, strict=True))
        others = [] if only_shapes else [e for e in scene.emitters() if not e.flags() & mi.EmitterFlags.Surface]
        others = [mi.traverse(e) for e in others]
        lights = lamps or any(dr.grad_enabled(p[k]) for p in others for k in PLACE_OF_LIGHT if k in p)
        turned = (*((m.shape, m) for m in self._maps), *self._bent)
        mapped = [shape for shape, what in turned if what.turns]
        sliding = tuple(dict.fromkeys(inner(m) for m in geometry.meshes if texture_slides(m)))
        turning = tuple(self.from_points and not moves[i] and normals_turn(m) for i, m in enumerate(geometry.meshes))
        return Moving(shapes, moves, camera, lights, tuple(dict.fromkeys((*mapped, *sliding))), sliding, turning)

    # ---------------------- Boundaries ----------------------

    def _refuse_moving_others(self, geometry: Geometry, changing: list[Parameter]) -> None:
        """Refuse derivatives with respect to shapes whose silhouettes are not known, inside of shape groups, too.

        changing : the parameters of the scene that carry a gradient.
        """
        known = {int(s.ptr) for s in geometry.known}
        others = [p for p in changing if isinstance(p.node, mi.Shape) and int(p.node.ptr) not in known]
        for name, shape, *_ in others:
            raise Refusal(
                f'{self.who}: shape "{shape.id()}" ({shape.class_name()}) moves ("{name}" carries a gradient), but its '
                "silhouettes cannot be sampled: only triangle meshes, spheres, disks, cylinders and b-spline curves "
                "outside of shape groups can move, and instances of meshes. Replace it by such a mesh, or detach it."
            )

    def _refuse_instances(self, moving: Moving) -> None:
        """Refuse instances that move, and are perfect mirrors or glass: how what they show slides is not known; and
        those that are flat, on which Mitsuba does not know what a ray meets."""
        mirrors = names(s for s in moving.shapes if hasattr(s, "instance") and is_mirror(s))
        if mirrors:
            raise Refusal(
                f"{self.who}: instances {listed(mirrors)} move, and are mirrors or glass: where the jumps in what "
                "they show go is not known. Replace them by meshes."
            )
        flat = names(s for s in moving.shapes if hasattr(s, "instance") and is_flat(s.instance))
        if flat:
            raise Refusal(
                f'{self.who}: instances {listed(flat)} move, and are flat: their "to_world" has no inverse. Give '
                "them a thickness."
            )

    def _find(
        self, scene: mi.Scene, sensor: mi.Sensor, moving: Moving, sppi: int, held: HeldShapes | None
    ) -> Boundaries:
        self._refuse_instances(moving)
        lights = Lights(scene)
        # What is held and moves behind edges that stand still comes out from behind them.
        on_film = np.array([m or moving.camera or held is not None for m in moving.flags], bool)
        sized = any(not e.flags() & mi.EmitterFlags.Delta for e in scene.emitters())
        soft = self.planes and self.depths.scatters(1) and (self.depths.scatters(2) or sized)
        edges = self._edges_of(self.geometry)
        seen = sppi and self.from_points and self.depths.scatters(2)
        horizons = HorizonsAtPoints.of(self.geometry, moving.turning) if seen and moving.anything else None
        turning, sppi = np.array(moving.turning, bool), sppi if moving.in_space else 0
        film, at_rest = None, self._at_rest(scene, moving, held)
        if on_film.any() or turning.any():
            film = FilmBoundary(
                *self._with_textures(moving, edges, at_rest), on_film, lights, soft=soft, turning=turning
            )
        film = film if film is not None and any(film.outlines.counts) else None
        planes = self._face_planes(scene, moving) if soft and sppi else None
        shadows, shading, indirect, lamps = self._in_reflected_light(scene, moving, sppi, horizons)
        lined = self._textures.shapes(moving.sliding) if self.from_points else ()
        abilities = {"planes": self.planes, "from_points": self.from_points}
        deep = None
        if shading is not None and self.from_surfaces and self.depths.scatters(3):
            deep = DeepShadows(scene, shading.silhouettes)
        limits = lasting_limits(scene, self.geometry, self._cracks, self.depths, moving, lined, sppi, **abilities)
        glass = self.from_points and self.depths.scatters(2) and not self.geometry.others
        glass = glass and slides_behind_glass(scene, FacePlanes(scene).shapes)
        slides = Slides.BEHIND_GLASS if glass else Slides.NOTHING
        what = moving.flags, moving.camera, moving.lights
        chains = self._chains(scene, moving, sppi, at_rest)
        coarse = sppi and self.planes and self.depths.scatters(1)
        coarse = LampPlanes.of(scene, self.geometry, FRINGE) if coarse else None
        any_mirror = chains[1] is not None
        mirrored = bool(any_mirror and sppi and self.depths.scatters(2))
        others = LightChoice.of(scene), deep, lamps, horizons, held, coarse, mirrored
        return Boundaries(film, shadows, shading, indirect, planes, *what, limits, slides, *chains, *others)

    @staticmethod
    def _at_rest(scene: mi.Scene, moving: Moving, held: HeldShapes | None) -> list[mi.Shape]:
        """The shapes of which lines of textures do not move relative to what is held on both sides. (Through veils,
        nothing is held.)"""
        sliding = [inner(s) for s in moving.sliding]
        return [s for s in held.shapes if s not in sliding] if held is not None and not has_veils(scene) else []

    def _textures_on_film(self, moving: Moving, at_rest: list[mi.Shape]) -> list[int]:
        """Of which meshes the camera sees the lines of textures as edges, besides those `at_rest`. Not of mirrors: rays
        part there, and would be found to part once more where they end."""
        found = self._textures.on_film([*moving.sliding, *at_rest]) if self.from_points else []
        seen = [i for i in found if moving.camera or moving.flags[i]]
        return [i for i in seen if not is_mirror(inner(self.geometry.meshes[i]))]

    def _with_textures(self, moving: Moving, edges: Edges, at_rest: list[mi.Shape]) -> tuple[Geometry, Edges]:
        """The shapes with these lines, and all edges. edges : the others."""
        meshes = self._textures_on_film(moving, at_rest)
        if not meshes:
            return self.geometry, edges
        geometry = replace(self.geometry, textures=self._textures)
        edges = self._edges_of(geometry)
        return geometry, edges.take((edges.of_textures(geometry) == 0) | np.isin(edges.mesh[:, 0], meshes))

    def _may_hold(self, sensor: mi.Sensor) -> bool:
        return self.holds and can_hold(sensor) and not self.geometry.others

    def _held(self, scene: mi.Scene, sensor: mi.Sensor, moving: Moving) -> HeldShapes | None:
        """The shapes whose points are held where the camera sees them, since they have fine textures, or are curved
        and polished. Found as the sensor of that moment sees them, and again when their textures have changed: see
        `Looks`."""
        if not self._may_hold(sensor):
            return None
        key = moving.camera, moving.flags
        count, held = self._fine.get(key, (-1, None))
        if count != self._looks.count and not dr.flag(dr.JitFlag.FreezingScope):
            shapes = surfaces(scene) if moving.camera else dict.fromkeys(inner(s) for s in moving.shapes)
            shapes = [s for s in shapes if has_points(s) and s.bsdf() is not None and not lets_rays_through(s)]
            rough = [s for s in shapes if not is_mirror(s)]
            as_edges = [inner(self.geometry.meshes[i]) for i in self._textures_on_film(moving, [])]
            fine = fine_textures(scene, sensor, rough, as_edges)
            fine += turning_lobes(scene, sensor, [s for s in shapes if s not in fine and is_curved(s)])
            if fine != (held.shapes if held is not None else []):
                held = HeldShapes(scene, fine) if fine else None
            self._fine[key] = self._looks.count, held
        return held

    def _chains(
        self, scene: mi.Scene, moving: Moving, sppi: int, at_rest: list[mi.Shape]
    ) -> tuple[bool, FineMirrors | None, TextureLines | None, ShownShadows | None, Surfaces | None]:
        """What has to be looked for on the film: see `Boundaries`, from `mirrors` on."""
        if not self.from_points:
            return False, None, None, None, None
        shows = self.depths.scatters(1)
        mirrors = [s for s in surfaces(scene) if is_mirror(s)] if shows else []
        # What is seen through veils lies where it is without them. So only what has no projection is looked for there.
        chains = bool(mirrors) or (self.depths.scatters(2) and has_veils(scene))
        textures = self._texture_lines(scene, moving, chains, at_rest)
        shown = ShownShadows(scene) if chains and sppi and self.depths.scatters(2) else None
        shown = shown if shown is not None and len(shown) else None
        chains = bool(mirrors) or (chains and bool(textures or shown))
        fine, met = FineMirrors(mirrors) if mirrors else None, Surfaces(scene) if chains or textures else None
        return chains, fine, textures, shown, met

    def _texture_lines(
        self, scene: mi.Scene, moving: Moving, mirrors: bool, at_rest: list[mi.Shape]
    ) -> TextureLines | None:
        """The lines of textures, and of what lights throw, that move as seen from the camera, or in mirrors and
        through veils."""
        shapes = surfaces(scene) if mirrors else dict.fromkeys(inner(s) for s in moving.with_lines)
        everywhere = mirrors or moving.camera or moving.lights
        sliding = [inner(s) for s in moving.sliding]
        # What mirrors with maps show jumps at their lines: these must be known, even if they do not move.
        at_rest = [s for s in at_rest if not is_mapped_mirror(s)]
        elsewhere = [*(inner(self.geometry.meshes[i]) for i in self._textures_on_film(moving, at_rest)), *at_rest]
        lit = None if everywhere else moving.shapes
        lines = TextureLines(shapes, scene.emitters(), lit, sliding, elsewhere)
        return lines if lines.besides_those or (mirrors and len(lines)) else None

    def _in_reflected_light(
        self, scene: mi.Scene, moving: Moving, sppi: int, horizons: HorizonsAtPoints | None
    ) -> tuple[ShadowBoundary | None, ShadingBoundary | None, tuple[IndirectShadows, ...], DividedLight | None]:
        """What samples the edges of which lights and shading points know, as far as it is needed; and the lamps near
        which points know of all edges."""
        if not sppi or not scene.emitters() or not self.depths.scatters(1):
            return None, None, (), None
        everything = moving.camera or moving.lights
        shapes = None if everything else list(moving.shapes)
        turning = None if self.depths.scatters(2) else shapes  # what a surface that moves lights may stand still
        lamps = DividedLight.of(scene, turning) if self.from_points and not self.geometry.others else None
        flags, divided = None if everything else moving.flags, lamps.shapes if lamps is not None else ()
        # Lines of textures move as surfaces see them: close by, or where texture coordinates change.
        jump = self.depths.scatters(2) or any(s.is_emitter() for s in moving.sliding)
        textures = self._textures if jump and self._textures.capacity else None
        geometry = replace(self.geometry, textures=textures)
        silhouettes = Silhouettes(geometry, self._edges_of(geometry), flags, divided, moving.sliding)
        if not len(silhouettes):
            return None, None, (), None
        shadows, shading, indirect = ShadowBoundary(scene, silhouettes), None, ()
        if self.from_points:
            shading = ShadingBoundary(scene, silhouettes, shapes, moving.sliding, horizons)
            needed = self.depths.scatters(2) or shading.emission_at_first or lamps is not None
            shading = shading if needed else None
            kinds = (IndirectShadows, IndirectBeams) if self.depths.scatters(2) else ()
            found = [kind(scene, silhouettes, shapes, hidden=self.from_surfaces) for kind in kinds]
            indirect = tuple(f for f in found if len(f))
        return shadows if len(shadows) else None, shading, indirect, lamps

    def _face_planes(self, scene: mi.Scene, moving: Moving) -> FacePlanes | None:
        """What samples the planes of faces, if what they hide can change: where the faces move, or what lights them.
        (The camera alone moves neither.)"""
        planes = FacePlanes(scene)
        what_lights = moving.lights or (moving.shapes and self.depths.scatters(2))
        return (
            planes if planes.shapes and (what_lights or any(inner(m) in planes.shapes for m in moving.shapes)) else None
        )

    def _limits_of_sensor(self, sensor: mi.Sensor, moving: Moving) -> list[str]:
        """What the derivative will lack as seen from this sensor. Found once, since it looks at positions."""
        key = (id(sensor), moving.flags, moving.camera)
        if key not in self._beyond and not dr.flag(dr.JitFlag.FreezingScope):
            # With the sensor, so that its number is given to no other one. Not all: scripts make one for each step.
            self._beyond[key] = sensor, cut_by_clipping_planes(sensor, list(moving.on_film))
            if len(self._beyond) > SENSORS:
                del self._beyond[next(iter(self._beyond))]
        return self._beyond[key][1] if key in self._beyond else []
