"""Free parameters: what an optimiser holds (latent numbers), and what a scene makes of it (its parameters)."""

from __future__ import annotations

import dataclasses
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight._plan import no_parameter
from rimlight.edge_sampling.geometry.meshes import (
    as_parameter,
    faces_of_positions,
    is_positions_key,
    points,
    present_key,
)
from rimlight.edge_sampling.refusals import InputError

from .problem import Free

#: Legal ranges of what a parameter's name says it is; the first that fits counts.
RANGES = (
    (r"(reflectance|transmittance|opacity|weight|metallic|specular|sheen|clearcoat|flatness|anisotropic)\b", 0, 1),
    (r"(tint|spec_trans|spec_tint|diff_trans|base_color|color)\b", 0, 1),
    (r"(alpha|alpha_u|alpha_v|roughness)\b", 1e-3, 1),
    (r"(eta|int_ior|ext_ior)\b", 1.0001, 5),
    (r"(radiance|irradiance|intensity|scale|sun_scale|sky_scale)\b", 0, np.inf),
    (r"fov\b", 1, 170),
)


#: Displacements and angles of rigid bodies are smaller: beyond it, sines of single precision are not finite.
FARTHEST = 1e9

#: Values of no parameter.
NOTHING: Mapping[str, Any] = MappingProxyType({})


class Parameter(ABC):
    """One entry of `Problem.free`, in a scene.

    name : for people; unique.
    keys : of the scene parameters that it makes.
    free : what was asked for.
    start, truth : latent name -> array of float32; where the fit begins, and the present state of the scene, which is
        the truth if the target is rendered from it.
    """

    def __init__(self, name: str, free: Free, keys: Iterable[str]):
        self.name, self.free, self.keys = name, free, tuple(keys)
        self.truth: dict[str, np.ndarray] = {}
        self.start: dict[str, np.ndarray] = {}

    @abstractmethod
    def values(self, latents: Mapping[str, mi.Float], so_far: Mapping[str, Any] = NOTHING) -> dict[str, Any]:
        """Scene parameters, by key, attached if the latents are. so_far : those of the parameters before this one."""

    def rates(self) -> dict[str, float]:
        """Learning rate of each latent."""
        return dict.fromkeys(self.start, self.free.rate)

    def legal(self, name: str, latent: np.ndarray) -> np.ndarray:
        """The nearest legal latent."""
        return latent

    def sound(self, latent: np.ndarray) -> bool:
        """Can a scene be made of these numbers of a latent?"""
        return bool(np.isfinite(latent).all())

    def mask(self, name: str) -> np.ndarray | None:
        """Which numbers of a latent are free. None: all."""
        return None

    def scatter(self, rng: np.random.Generator, move: float, turn: float, value: float) -> dict[str, np.ndarray]:
        """A start elsewhere: normally distributed around the one that was asked for."""
        found = {}
        for name, start in self.start.items():
            mask = self.mask(name)
            change = value * rng.standard_normal(start.shape) * (1 if mask is None else mask)
            found[name] = self.legal(name, (start + change).astype(np.float32))
        return found

    @abstractmethod
    def errors(self, latents: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Distance from the truth, by a label with its unit."""


class RigidBody(Parameter):
    """Vertices of meshes, or transformations, that move together by a twist: a displacement and a rotation vector about
    a centre, both in world space. Their values at the truth are what the scene has. Vertices that are free themselves
    are displaced first; the centre stays that of the scene."""

    def __init__(self, name: str, free: Free, initial: Mapping[str, Any]):
        super().__init__(name, free, initial)
        self.initial = dict(initial)
        points = np.concatenate([_points(value) for value in initial.values()])
        #: (3,), world space.
        self.centre = points.mean(0)
        #: Radius of the body; of frames alone that are in one place, such as a camera, 1.
        self.size = float(np.linalg.norm(points - self.centre, axis=1).max()) or 1.0
        self.move, self.turn = f"{name}.move", f"{name}.turn"
        self.truth = {self.move: np.zeros(3, np.float32), self.turn: np.zeros(3, np.float32)}
        start = _numbers(free.start, {6}, name, "6 numbers") if free.start else np.zeros(6)
        self.start = {self.move: start[:3].astype(np.float32), self.turn: np.radians(start[3:]).astype(np.float32)}

    def values(self, latents, so_far=NOTHING):
        shift, rotation = (dr.unravel(mi.Vector3f, latents[k]) for k in (self.move, self.turn))
        moved = rotate_and_shift(rotation, shift, mi.Point3f(self.centre))
        return {
            key: moved @ value if is_transform(value) else as_parameter(dr.ravel(moved @ points(value)), value)
            for key, value in ((key, so_far.get(key, initial)) for key, initial in self.initial.items())
        }

    def sound(self, latent):
        return bool((np.abs(latent) < FARTHEST).all())

    def rates(self):
        turn = self.free.rate / self.size if self.free.turn_rate is None else self.free.turn_rate
        return {self.move: self.free.rate, self.turn: turn}

    def mask(self, name):
        return _axes(self.free.move if name == self.move else self.free.turn)

    def scatter(self, rng, move, turn, value):
        spread = {self.move: move, self.turn: np.radians(turn)}
        return {
            name: (start + spread[name] * self.mask(name) * rng.standard_normal(3)).astype(np.float32)
            for name, start in self.start.items()
        }

    def errors(self, latents):
        turned = _rotation(latents[self.turn]).T @ _rotation(self.truth[self.turn])
        angle = np.degrees(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)))
        shift = np.linalg.norm(latents[self.move] - self.truth[self.move])
        found = {}
        if self.free.move:
            found[f"{self.name}: distance (scene units)"] = float(shift)
        if self.free.turn:
            found[f"{self.name}: angle (degrees)"] = float(angle)
        return found


class Vertices(Parameter):
    """Vertex positions, one by one. Vertices of equal position stay together, so that seams do not open."""

    def __init__(self, name: str, free: Free, key: str, initial: Any, faces: np.ndarray):
        super().__init__(name, free, [key])
        self.key, self.kind = key, type(initial)
        place = np.array(initial, np.float32).reshape(-1, 3)
        _, first, weld = np.unique(place, axis=0, return_index=True, return_inverse=True)
        self.first, self.weld = first, mi.UInt(weld.ravel())
        chosen = np.zeros((len(first), 3), np.float32)
        np.maximum.at(chosen, weld.ravel(), self._chosen(len(place)))  # who moves one of a place, moves all
        self.chosen = chosen.ravel()
        offset = (
            _numbers(free.start, {3, place.size}, name, f"3 or {place.size} numbers") if free.start else np.zeros(3)
        )
        started = place + np.resize(offset, place.shape).astype(np.float32) * self.chosen.reshape(-1, 3)[self.weld]
        self.large_steps = _large_steps(initial, faces, free.smoothing) if free.smoothing else None
        self.truth, self.start = {key: self._latent(place)}, {key: self._latent(started)}

    def _latent(self, place: np.ndarray) -> np.ndarray:
        if self.large_steps:
            return np.array(self.large_steps.to_differential(mi.Float(place.ravel())), np.float32).ravel()
        return place[self.first].ravel()

    def values(self, latents, so_far=NOTHING):
        if self.large_steps:
            found = self.large_steps.from_differential(latents[self.key])
            flat = found.array if dr.is_tensor_v(found) else found
        else:
            flat = dr.ravel(dr.gather(mi.Point3f, latents[self.key], self.weld))
        return {self.key: as_parameter(flat, self.kind())}

    def mask(self, name):
        return None if self.large_steps else self.chosen

    def _chosen(self, count: int) -> np.ndarray:
        """1 where a coordinate is free: (count, 3)."""
        chosen = np.tile(_axes(self.free.move), (count, 1))
        if self.free.vertices:
            if max(self.free.vertices) >= count or min(self.free.vertices) < 0:
                raise InputError(f'fit: "{self.name}" has vertices 0 … {count - 1}, got {list(self.free.vertices)}')
            chosen[np.setdiff1d(np.arange(count), self.free.vertices)] = 0
        if self.free.smoothing and not chosen.all():
            raise InputError(f'fit: smoothing moves all vertices of "{self.name}" in all directions')
        return chosen

    def errors(self, latents):
        place = lambda x: np.array(self.values({self.key: mi.Float(x)})[self.key]).reshape(-1, 3)
        distance = np.linalg.norm(place(latents[self.key]) - place(self.truth[self.key]), axis=1)
        return {
            f"{self.name}: root mean square distance (scene units)": float(np.sqrt(np.mean(distance**2))),
            f"{self.name}: farthest vertex (scene units)": float(distance.max()),
        }


class Values(Parameter):
    """Numbers of a material, light, texture or lens, within their legal range."""

    def __init__(self, name: str, free: Free, key: str, initial: Any):
        super().__init__(name, free, [key])
        self.key, self.kind = key, type(initial)
        self.shape = initial.shape if dr.is_tensor_v(initial) else None
        truth = to_numpy(initial).ravel().astype(np.float32)
        inwards = reversed(key.split(".")[1:])  # without the identifier, which says nothing
        ranges = ((a, b) for name in inwards for pattern, a, b in RANGES if re.search(pattern, name))
        low, high = next(ranges, (-np.inf, np.inf))
        self.low = low if free.lower is None else free.lower
        self.high = high if free.upper is None else free.upper
        counts = {1, len(truth)}
        start = _numbers(free.start, counts, name, f"1 or {len(truth)} numbers") if free.start else truth
        self.truth = {key: truth}
        self.start = {key: np.resize(start, len(truth)).astype(np.float32)}
        if free.unit_length and (truth.size % 3 or not np.linalg.norm(self.start[key].reshape(-1, 3), axis=1).all()):
            raise InputError(
                f'fit: "{key}" has no rows of three numbers, or one of length 0: it cannot have unit_length'
            )
        if not np.array_equal(self.legal(key, self.start[key]), self.start[key]) and not free.unit_length:
            raise InputError(
                f'fit: "{key}" starts outside of its legal range {self.low} … {self.high}; '
                "set lower and upper if that is meant"
            )
        self.start[key] = self.legal(key, self.start[key])

    def values(self, latents, so_far=NOTHING):
        return {self.key: from_flat(latents[self.key], self.kind, self.shape)}

    def legal(self, name, latent):
        latent = np.clip(latent, self.low, self.high)
        if self.free.unit_length:
            rows = latent.reshape(-1, 3)
            latent = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).ravel()
        return latent.astype(np.float32)

    def errors(self, latents):
        """Root mean square error over the root mean square of the truth."""
        truth, now = self.truth[self.key], latents[self.key]
        size = np.sqrt(np.mean(np.square(truth))) or 1
        return {f"{self.name}: relative error": float(np.sqrt(np.mean(np.square(now - truth))) / size)}


# ------------------------------------------------------------------ from a problem to parameters


def find(free: Iterable[Free], params: Any) -> list[Parameter]:
    """The free parameters in a scene.

    params : `mi.traverse(scene)`.

    Raises
    ------
    ValueError : a key is unknown, is free twice, cannot be differentiated, or `start` does not fit it.
    """
    found: list[Parameter] = []
    for entry in free:
        entry = dataclasses.replace(entry, key=tuple(present_key(params, key) for key in entry.key))
        for key in entry.key:
            check_key(key, params)
        moves_whole = lambda key, kind=entry.kind: (
            is_transform(params[key]) or (kind == "pose" and is_positions_key(key))
        )
        rigid = [key for key in entry.key if moves_whole(key)]
        _check_free_once(entry, rigid, found)
        if rigid:
            name = _body(rigid[0]) if len(rigid) == 1 else " + ".join(map(_body, rigid[:3])) + " …" * (len(rigid) > 3)
            if any(p.name == name for p in found):
                name += " (whole)"
            found.append(RigidBody(name, entry, {key: _copy(params[key]) for key in rigid}))
        for key in entry.key:
            if key in rigid:
                continue
            if is_positions_key(key):
                found.append(Vertices(_body(key), entry, key, _copy(params[key]), faces_of_positions(params, key)))
            else:
                found.append(Values(key, entry, key, _copy(params[key])))
    for parameter in found:
        masks = [parameter.mask(name) for name in parameter.start]
        if not any(mask is None or mask.any() for mask in masks):
            raise InputError(f'fit: "{parameter.name}" cannot move: move, turn or vertices leave nothing free')
    return found


def _check_free_once(entry: Free, rigid: Iterable[str], found: Iterable[Parameter]) -> None:
    """Vertices may be free one by one, and then, in a later entry, together."""
    for key in entry.key:
        before = [p for p in found if key in p.keys]
        as_both = key in rigid and len(before) == 1 and isinstance(before[0], Vertices)
        if entry.key.count(key) > 1 or (before and not as_both):
            raise InputError(
                f'fit: "{key}" is free twice; vertices may be, with the kind "shape", and then, in a later entry, '
                'with the kind "pose"'
            )


def check_key(key: str, params: Any, who: str = "fit") -> None:
    """InputError : the scene has no such parameter, or it has no derivative. who : speaks in the message."""
    if key not in params:
        raise InputError(f"{who}: {no_parameter(params, key)}")
    value = params[key]
    if not is_transform(value) and not (dr.is_diff_v(value) and dr.is_float_v(value)):
        raise InputError(f'{who}: "{key}" is of type {type(value).__name__}, which has no derivative')


# ------------------------------------------------------------------ values of scenes


def values(parameters: Iterable[Parameter], latents: Mapping[str, mi.Float]) -> dict[str, Any]:
    """Scene parameters of all free parameters, by key, attached if the latents are."""
    found: dict[str, Any] = {}
    for parameter in parameters:
        found |= parameter.values(latents, found)
    return found


def to_numpy(value: Any) -> np.ndarray:
    """A scene parameter as float32: a matrix (4, 4), a tensor in its shape, else flat."""
    value = dr.detach(value)
    if is_transform(value):
        return np.array(value.matrix, np.float32).reshape(4, 4)
    return np.array(value if dr.is_tensor_v(value) else dr.ravel(value), np.float32)


def from_flat(flat: mi.Float, kind: type, shape: Any = None) -> Any:
    """A scene parameter of this type from its numbers, attached if they are."""
    if dr.is_tensor_v(kind):
        return kind(flat, shape)
    if _is_transform_type(kind):
        rows = [[dr.gather(mi.Float, flat, 4 * i + j) for j in range(4)] for i in range(4)]
        return mi.Transform4f(mi.Matrix4f(rows))
    return dr.unravel(kind, flat) if dr.size_v(kind) > 1 else kind(flat)


def rotate_and_shift(rotation: mi.Vector3f, shift: mi.Vector3f, centre: mi.Point3f) -> mi.Transform4f:
    """x -> exp([rotation]×) (x − centre) + centre + shift, by Rodrigues' formula; smooth at 0 as well."""
    θ2 = dr.squared_norm(rotation)
    small = θ2 < 1e-4
    safe = dr.select(small, 1, θ2)
    θ = dr.sqrt(safe)
    a = dr.select(small, 1 - θ2 / 6, dr.sin(θ) / θ)
    b = dr.select(small, 0.5 - θ2 / 24, (1 - dr.cos(θ)) / safe)
    x, y, z = rotation
    K = mi.Matrix3f([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    R = dr.identity(mi.Matrix3f) + a * K + b * (K @ K)
    t = centre + shift - R @ centre
    rows = [[R[i, 0], R[i, 1], R[i, 2], t[i]] for i in range(3)]
    return mi.Transform4f(mi.Matrix4f([*rows, [0, 0, 0, 1]]))


def _rotation(vector: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(np.asarray(vector, np.float64)).as_matrix()


def is_transform(value: Any) -> bool:
    # Vectors have an attribute "matrix", too: Dr.Jit takes the letters for a swizzle.
    return _is_transform_type(type(value))


def _is_transform_type(kind: type) -> bool:
    return "Transform" in kind.__name__


def _points(value: Any) -> np.ndarray:
    """Points of a body, (N, 3), world space: vertices, or the origin of a frame."""
    if is_transform(value):
        return to_numpy(value)[None, :3, 3]
    return to_numpy(value).reshape(-1, 3)


def _copy(value: Any) -> Any:
    return type(value)(dr.detach(value))


def _axes(letters: str) -> np.ndarray:
    return np.array([axis in letters for axis in "xyz"], np.float32)


def _body(key: str) -> str:
    return key.rpartition(".")[0] or key


def _numbers(numbers: tuple[float, ...], counts: set[int], name: str, expected: str) -> np.ndarray:
    if len(numbers) not in counts:
        raise InputError(f'fit: the start of "{name}" needs {expected}, got {len(numbers)}')
    if bad := [x for x in numbers if not np.isfinite(x)]:
        raise InputError(f'fit: the start of "{name}" must be finite, got {bad[0]}')
    return np.array(numbers, np.float64)


def check_smoothing() -> None:
    """InputError : the package is missing that smoothing needs."""
    try:
        import cholespy  # noqa: F401
    except ImportError as error:
        raise InputError("fit: smoothing needs the package cholespy: pip install cholespy") from error


def _large_steps(positions: Any, faces: np.ndarray, smoothing: float) -> Any:
    check_smoothing()
    triangles = mi.TensorXu(faces) if dr.is_tensor_v(positions) else mi.UInt(faces.ravel())
    return mi.ad.LargeSteps(positions, triangles, smoothing)
