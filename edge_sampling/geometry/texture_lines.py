"""Lines at which textures jump: checkerboards, bitmaps with the `nearest` filter, the slopes of bump maps, and what
does not go on around a sphere; and those along which mapped normals turn away from the viewer; and those at which the
light of spots and projectors jumps.

Each of them is where a function of a point on the surface is whole. Textures jump at the lines of a lattice: where a
component of A·(u, v, 1) is whole, with a matrix A of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .beams import BEAMS, ROUNDING, BeamBorder, has_hard_beam, on_texture
from .boxes import box_around
from .mapped_horizons import mapped_horizons
from .meshes import (
    Geometry,
    attribute_names,
    bends_light,
    has_interpolated_normals,
    has_place,
    has_texcoords,
    inner,
    is_map,
    is_met,
    objects_below,
    pointer,
    surfaces,
    texture_coordinates,
)
from .texture_seams import SEAM_OF, jumps_at_seam, texture_value

#: The texture that shows a volume on a surface.
VOLUME = "VolumeAdapter"

#: Texture units of GPUs know places between texels in steps of this size (documentation of `drjit.cuda.Texture2f`).
TEXTURE_UNIT_STEP = 1 / 256

#: Texels at which a bitmap is looked at for such steps, places in each step, and the first texels of a row that are
#: looked at: as far as single precision tells these places apart.
TEXELS, PLACES_OF_STEP, FIRST_TEXELS = 1024, 8, 2048

#: Points at which a volume is looked at for its brightest and its darkest voxel.
PLACES = 2**20


#: Which textures jump, within `looked_at_once`: by texture, and by where it was looked at. The textures are kept as
#: well, so that nothing else gets their numbers.
_KNOWN: ContextVar[dict[tuple, tuple[Any, bool]] | None] = ContextVar("_KNOWN", default=None)


@contextmanager
def looked_at_once() -> Iterator[None]:
    """Look at each texture once, though many shapes may have it, and several ask. Nothing may change meanwhile."""
    token = _KNOWN.set({})
    try:
        yield
    finally:
        _KNOWN.reset(token)


@dataclass(frozen=True)
class Lattice:
    """Where one texture jumps.

    matrix : A, (2, 3).
    light : whose texture it is; None: it is one of a shape.
    step : so far from its lines, in texels, what belongs to one side may be found on the other.
    """

    matrix: np.ndarray
    light: mi.Emitter | None = None
    step: float = 0.0

    @property
    def size(self) -> float:
        """Largest coordinate in it of texture coordinates up to 1, or what stands for it, by which it is rounded."""
        return float(np.abs(self.matrix).sum(1).max()) * (1.0 if self.light is None else ROUNDING)

    def at(self, si: mi.SurfaceInteraction3f) -> mi.Vector2f:
        """Place in the lattice; attached, if the texture coordinates are. Outside of beams the same everywhere."""
        (a, b, c), (d, e, f) = self.matrix.tolist()
        uv = si.uv if self.light is None else on_texture(self.light, si)
        if self.light is not None:
            inside = dr.all((uv >= 0) & (uv <= 1))
            uv = dr.select(inside, dr.minimum(uv, dr.one_minus_epsilon(mi.Float)), 0.5)
        return mi.Vector2f(a * uv.x + b * uv.y + c, d * uv.x + e * uv.y + f)


@dataclass(frozen=True)
class Line:
    """One line.

    kind : mi.UInt32, number of the function that is whole there. second : mi.Bool, is its second component?
    """

    kind: mi.UInt32
    second: mi.Bool


class TextureLines:
    """The lines on shapes.

    shapes : those whose own lines count.
    lights : those whose lines count.
    lit : shapes on which these count; None: on all.
    sliding : shapes whose texture coordinates change.
    elsewhere : shapes the jumps of whose textures are none, or edges of the film boundary, where the camera sees them
        directly.
    """

    DRJIT_STRUCT = dict.fromkeys(("_sizes", "_steps", "_elsewhere"))  # for `dr.freeze`

    def __init__(
        self,
        shapes: Sequence[Any],
        lights: Sequence[mi.Emitter] = (),
        lit: Sequence[Any] | None = None,
        sliding: Sequence[Any] = (),
        elsewhere: Sequence[Any] = (),
    ):
        # Of each shape, lattices last, since the last line counts where several are found: the slopes of bump maps jump
        # there, and so may whether they turn away.
        of_shapes = [(s, [*mapped_horizons(s), *lattices(s)]) for s in shapes]
        # The border of a beam counts where the texture of the light jumps as well.
        of_lights = [kind for light in lights for kind in lines_of_beam(light)]
        self.kinds = [kind for _, kinds in of_shapes for kind in kinds] + of_lights
        #: The largest value of each function where the texture coordinates are at most 1.
        self._sizes = mi.Float([k.size for k in self.kinds] or [1])
        self._steps = mi.Float([getattr(k, "step", 0.0) for k in self.kinds] or [0])
        others = [s in elsewhere and isinstance(kind, Lattice) for s, kinds in of_shapes for kind in kinds]
        self._elsewhere = mi.Bool([*others, *(False for _ in of_lights)] or [False])
        #: Are there any but those?
        self.besides_those = len(self.kinds) > sum(others)
        numbers = iter(range(len(self.kinds)))
        #: Shapes, and the numbers of their functions.
        self._shapes = [(s, [next(numbers) for _ in kinds]) for s, kinds in of_shapes if kinds]
        self._of_lights, self._lit = list(numbers), lit
        #: Meshes whose edges count for all that jumps there, and move with it.
        self._at_edges = [s for s, _ in self._shapes if s.is_mesh() and s not in sliding and jumps_at_every_edge(s)]

    def __len__(self) -> int:
        return len(self.kinds)

    def cell(self, si: mi.SurfaceInteraction3f, direct: mi.Bool) -> mi.UInt32:
        """A number for the part of a surface between the lines. direct : does the camera see it, through veils at the
        most? Then lines of `elsewhere` do not count."""
        found = mi.UInt32(0)
        for which, there in self._of(si):
            there &= ~(direct & dr.gather(mi.Bool, self._elsewhere, which))
            at = mi.Point2i(dr.floor(self._at(which, si, there)))
            cell = mi.sample_tea_32(found ^ mi.UInt32(at.x), mi.UInt32(at.y))[0]
            found = dr.select(there, cell, found)
        return found

    def has_own(self, si: mi.SurfaceInteraction3f) -> mi.Bool:
        """Is a point on a mesh that has lines of its own? (The seams of other shapes are lines like all others.)"""
        return _is_one_of(si, [shape for shape, _ in self._shapes if shape.is_mesh()])

    def jump_at_edges(self, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool) -> mi.Bool:
        """Does what jumps between two faces of the mesh that is met jump at their edge, and not at a line?"""
        if not self._at_edges:
            return mi.Bool(False)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
        return active & _is_one_of(si, self._at_edges)

    def between(self, a: mi.SurfaceInteraction3f, b: mi.SurfaceInteraction3f) -> Line:
        """The line between two points of a surface that are next to each other."""
        line = Line(mi.UInt32(0), mi.Bool(False))
        for which, there in self._of(a):
            p, q = (dr.floor(self._at(which, si, there)) for si in (a, b))
            mine = there & ((p.x != q.x) | (p.y != q.y))
            line = Line(dr.select(mine, which, line.kind), dr.select(mine, p.x == q.x, line.second))
        return line

    def across(self, line: Line, si: mi.SurfaceInteraction3f) -> mi.Float:
        """The function that is whole at a line; attached, if `si` is."""
        at = self._at(line.kind, si, True)
        return dr.select(line.second, at.y, at.x)

    def rounding(self, line: Line, si: mi.SurfaceInteraction3f) -> mi.Float:
        """A unit in the last place of the function that is whole at a line. Detached."""
        size = dr.gather(mi.Float, self._sizes, line.kind)
        return dr.epsilon(mi.Float) * dr.maximum(size, dr.abs(dr.detach(self.across(line, si))))

    def step(self, line: Line) -> mi.Float:
        """So far from a line, in units of its function, what belongs to one side may be found on the other."""
        return dr.gather(mi.Float, self._steps, line.kind)

    def _of(self, si: mi.SurfaceInteraction3f) -> Iterator[tuple[mi.UInt32, mi.Bool]]:
        """The functions of a point, one after the other: their numbers, and whether its shape has so many."""
        for k in range(max((len(numbers) for _, numbers in self._shapes), default=0)):
            which, there = mi.UInt32(0), mi.Bool(False)
            for shape, numbers in self._shapes:
                if k < len(numbers):
                    mine = si.shape == mi.ShapePtr(shape)
                    which, there = dr.select(mine, numbers[k], which), there | mine
            yield which, there
        for number in self._of_lights:
            yield mi.UInt32(number), si.is_valid() if self._lit is None else _is_one_of(si, self._lit)

    def _at(self, which: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool | bool) -> mi.Vector2f:
        """The value of one function. As calls, since a scene may have many maps, each of them with a texture."""
        return dr.switch(which, [lambda si, active, kind=kind: kind.at(si) for kind in self.kinds], si, mi.Bool(active))


def _is_one_of(si: mi.SurfaceInteraction3f, shapes: Sequence[Any]) -> mi.Bool:
    found = mi.Bool(False)
    for shape in shapes:
        found |= is_met(si, pointer(shape))
    return found


def lines_of_beam(light: mi.Emitter) -> list[Any]:
    """Where the light of a spot or a projector jumps."""
    border = [BeamBorder(light)] if has_hard_beam(light) else []
    return [*lattices(light, light), *border] if light.class_name() in BEAMS else []


def lattices(shape: Any, light: mi.Emitter | None = None) -> list[Lattice]:
    """Of the textures of a shape, or of a light, that jump."""
    of_mesh = isinstance(shape, mi.Mesh) and has_texcoords(shape)
    uv = texture_coordinates(shape) if of_mesh else np.zeros((0, 2))
    found = []
    below = objects_below(shape)
    bumps = [below.get(f"{name}.nested_texture") for name, o in below.items() if o.class_name() == "BumpMap"]
    for o in below.values():
        if not has_place(o):
            continue
        to_uv = np.array(mi.traverse(o)["to_uv"].matrix, float)[:2]
        size = np.array(o.resolution() if o.class_name().startswith("Bitmap") else (2, 2), float)
        matrix = size[:, None] * to_uv
        if any(o is t for t in bumps):
            # Slopes jump in the middle of texels. GPUs may take a place close to it for one on the other side.
            step = TEXTURE_UNIT_STEP if _in_steps(o) else 0.0
            found.append(Lattice(matrix - [[0, 0, 0.5], [0, 0, 0.5]], light, step))
        elif _jumps(o, *_range(o, uv)):
            found.append(Lattice(matrix, light))
        elif light is None and jumps_at_seam(o, shape.class_name()):
            # On a circle, there is no function that jumps once only: on the other side, a line counts that is none.
            halves, k = np.array([[0, 0, 0.5], [0, 0, 0.5]]), SEAM_OF[shape.class_name()]
            halves[k, k], halves[k, 2] = 2, 0
            found.append(Lattice(halves))
    return found


def jumps_at_every_edge(mesh: Any) -> bool:
    """Does something jump wherever two faces of the mesh meet? Attributes of faces; textures without texture
    coordinates, for which the place inside of its own triangle stands; and what depends on the tangents of a face:
    anisotropic materials, bump and normal maps. And textures that jump where light goes through a smooth-shaded mesh,
    of which all that differs between two faces is compared at their edge, for the sake of their planes."""
    if attribute_names(mesh, "face_"):
        return True
    shape = inner(mesh)
    rough = bends_light(shape) and shape.bsdf().flags() & mi.BSDFFlags.Smooth
    if rough and has_interpolated_normals(mesh) and lattices(shape):
        return True
    objects = list(objects_below(shape).values())
    if any(isinstance(o, mi.BSDF) and (o.flags() & mi.BSDFFlags.Anisotropic or is_map(o)) for o in objects):
        return True
    return not has_texcoords(mesh) and any(has_place(o) for o in objects)


def jumping_textures(scene: mi.Scene, besides: Sequence[Any] = (), *, seams: bool = True) -> list[str]:
    """Names of what jumps inside of faces: checkerboards, bitmaps with the `nearest` filter, bump maps (where a bitmap
    is continuous, its slope jumps at every texel), and volumes that jump between their voxels.

    besides : shapes whose textures are not asked for, but for volumes, whose jumps are not known as lines.
    seams : do those count that jump where the texture coordinates of a sphere begin and end?
    """
    below = lambda owners: {id(o): o for owner in owners for o in objects_below(owner).values()}
    # A scene file may define materials, or wrap them, that no shape refers to.
    used = below((*surfaces(scene), *scene.emitters()))
    known = [k for k, o in below(besides).items() if o.class_name() != VOLUME]
    at_seam = [
        id(o)
        for s in surfaces(scene)
        if seams and s.class_name() in SEAM_OF
        for o in objects_below(s).values()
        if has_place(o) and jumps_at_seam(o, s.class_name())
    ]
    box = box_around(scene)
    uv = [texture_coordinates(m) for m in Geometry.of(scene).meshes if has_texcoords(m)]
    uv = np.concatenate([np.zeros((0, 2)), *uv])
    return [
        f'"{name}" ({o.class_name().partition("TextureImpl")[0]})'
        for name, o in objects_below(scene).items()
        if id(o) in used
        and id(o) not in known
        and (
            (isinstance(o, mi.BSDF) and o.class_name() == "BumpMap")
            or (has_place(o) and (id(o) in at_seam or _jumps(o, *_range(o, uv))))
            or (o.class_name() == VOLUME and box.valid() and _jumps(o, list(box.min), list(box.max)))
        )
    ]


def maps_in_steps(shapes: Sequence[Any]) -> list[str]:
    """Names of the bitmaps of normals and heights which a GPU interpolates in steps."""
    found = {}
    for shape in shapes:
        below = objects_below(inner(shape))
        for name, o in below.items():
            if isinstance(o, mi.BSDF) and is_map(o):
                child = f"{name}.{'nested_texture' if o.class_name() == 'BumpMap' else 'normalmap'}"
                texture = below.get(child.lstrip("."))
                if texture is not None and has_place(texture) and _in_steps(texture):
                    found[id(texture)] = f'"{shape.id()}.{child}"'
    return list(found.values())


def _in_steps(texture: mi.Texture) -> bool:
    """Is a bitmap interpolated between the middles of its texels by no more than `1 / TEXTURE_UNIT_STEP` values?"""
    if not texture.class_name().startswith("Bitmap"):
        return False
    size = np.array(texture.resolution(), float)
    # Well inside of texels, where `nearest` bitmaps do not change at all
    random = np.random.default_rng(0)
    corners = random.integers(0, np.minimum(size, FIRST_TEXELS), (TEXELS, 2)) + random.uniform(0.1, 0.9, (TEXELS, 2))
    apart = TEXTURE_UNIT_STEP / PLACES_OF_STEP * np.arange(2 * PLACES_OF_STEP + 1)
    uv = _from_texture(texture, ((corners[:, None] + apart[:, None]) / size).reshape(-1, 2))
    with dr.suspend_grad():
        values = np.array(texture_value(texture, mi.Point2f(uv.T.astype(np.float32)))).reshape(-1, TEXELS, len(apart))
    same = (np.diff(values, axis=2) == 0).all(0)  # in all channels
    varies = ~same.all(1)
    return bool(varies.any() and same[varies].mean() > 0.5)


def texture_values(texture: mi.Texture) -> list[Any]:
    """Texels, or colours: arrays, detached."""
    return [dr.detach(v).array for v in _colours(texture)]


def is_even(texture: mi.Texture) -> bool:
    """Does a texture have the same value everywhere, as it is now? Then it does not jump, but it may come to do so."""
    colours = [np.array(dr.detach(v)) for v in _colours(texture)]
    rows = [v.reshape(-1, v.shape[-1] if v.ndim == 3 else v.size) for v in colours]
    return all(r.shape[1] == rows[0].shape[1] and (r == rows[0][0]).all() for r in rows)


def numbers_of_place(name: str, value: Any) -> list[Any]:
    """What a parameter of a texture tells of where its texels are: its resolution, or the map from texture
    coordinates."""
    if name.endswith("data"):
        return list(value.shape)
    return np.array(value.matrix).tolist() if name.endswith("to_uv") else []


def _colours(texture: mi.Texture) -> list[Any]:
    return [v for key, v in mi.traverse(texture).items() if key.endswith(("data", "value"))]


def _jumps(texture: Any, lower: list[float], upper: list[float]) -> bool:
    """Does a texture jump between these coordinates?"""
    known, key = _KNOWN.get(), (id(texture), *lower, *upper)
    if known is None:
        return _bisected(texture, lower, upper)
    if key not in known:
        known[key] = texture, _bisected(texture, lower, upper)
    return known[key][1]


def _bisected(texture: Any, lower: list[float], upper: list[float], pairs: int = 256, steps: int = 22) -> bool:
    """Bisect segments towards their steeper half: where a texture is continuous, the difference dies out. They are
    random, and that between the brightest texel or voxel and the darkest, since few may differ from all others.

    lower, upper : of the texture coordinates; of volumes, which vary in space, of the scene.
    """
    in_space = len(lower) == 3
    ends = np.random.default_rng(0).uniform(lower, upper, (pairs, 2, len(lower)))
    value = partial(texture_value, texture)
    with dr.suspend_grad():
        extremes = _brightest_and_darkest_in_space(texture, value) if in_space else _brightest_and_darkest(texture)
        ends = np.concatenate([ends, extremes]).astype(np.float32)
        difference = lambda f, g: dr.max(dr.abs(f - g))
        p, q = ((mi.Point3f if in_space else mi.Point2f)(ends[:, k].T) for k in (0, 1))
        at_p, at_q = value(p), value(q)
        before = difference(at_p, at_q)
        # Rounding makes differences, too, where a texture is constant.
        least = dr.maximum(1e-3 * dr.max(before), 1e-5 * dr.max(difference(at_p, 0)))
        for _ in range(steps):
            middle = 0.5 * (p + q)
            at_middle = value(middle)
            left = difference(at_p, at_middle) > difference(at_middle, at_q)
            p, at_p = dr.select(left, p, middle), dr.select(left, at_p, at_middle)
            q, at_q = dr.select(left, middle, q), dr.select(left, at_middle, at_q)
        return bool(dr.any((before > least) & (difference(at_p, at_q) > 0.3 * before)))


def _brightest_and_darkest(texture: mi.Texture) -> np.ndarray:
    """Texture coordinates of these two texels of a bitmap: (2, 2, 2), whichever of its sides is the lower one."""
    params = mi.traverse(texture)
    if "data" not in params:
        return np.zeros((0, 2, 2))
    data = sum(np.moveaxis(np.array(dr.detach(params["data"])), 2, 0))
    y, x = np.unravel_index([data.argmax(), data.argmin()], data.shape)
    u, v = (x + 0.5) / data.shape[1], (y + 0.5) / data.shape[0]
    return _from_texture(texture, np.stack([np.stack([u, w], -1) for w in (v, 1 - v)]))


def _range(texture: mi.Texture, uv: np.ndarray) -> tuple[list[float], list[float]]:
    """The least and the largest texture coordinates at which a texture is looked at: those of a mesh, (V, 2), and those
    of the whole texture, since the mesh may come to show other parts of it."""
    uv = np.concatenate([[[0, 0], [1, 1]], _from_texture(texture, np.array([[0, 0], [0, 1], [1, 0], [1, 1]])), uv])
    return uv.min(0).tolist(), uv.max(0).tolist()


def _from_texture(texture: mi.Texture, places: np.ndarray) -> np.ndarray:
    """The texture coordinates of places in a texture, from 0 to 1: (..., 2) both."""
    to_uv = np.array(mi.traverse(texture)["to_uv"].matrix, float)
    return (places - to_uv[:2, 2]) @ np.linalg.pinv(to_uv[:2, :2]).T


def _brightest_and_darkest_in_space(texture: mi.Texture, value: Callable[[mi.Point3f], mi.Spectrum]) -> np.ndarray:
    """Places of these two values of a volume, of many that are random: (1, 2, 3).

    Where its voxels are, Mitsuba does not tell: a part that is smaller than one in as many is not found.
    """
    box = next(o for o in objects_below(texture).values() if isinstance(o, mi.Volume)).bbox()
    places = np.random.default_rng(1).uniform(list(box.min), list(box.max), (PLACES, 3))
    found = np.array(dr.sum(value(mi.Point3f(places.T.astype(np.float32)))))
    return places[[[found.argmax(), found.argmin()]]]
