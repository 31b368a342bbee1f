"""One-parameter motions of a scene: what is differentiated, by the integrators and by finite differences alike."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight._collection import no_collection
from rimlight._plan import no_parameter
from rimlight.edge_sampling.geometry.meshes import is_positions_key, present_key
from rimlight.edge_sampling.refusals import InputError

#: Of longer lists, a motion's text shows so many entries only: a grid of 64³ values would make it 3 MB.
SHOWN = 32


class Motion:
    """Moves one parameter of a scene along a line, or turns it about an axis: p(θ), where p(0) is its present value.

    Parameters
    ----------
    scene : mi.Scene
    key : name of the parameter, as `mi.traverse(scene)` has it.
    direction : displacement per unit of θ. For vertex positions and `to_world`, 3 numbers, world space; for any other
        parameter as many numbers as it has, or 1 for all.
    rotate : axis, 3 numbers, world space (need not be normalised); θ in radians. Only for vertex positions and
        `to_world`.
    pivot : 3 numbers, world space, a point on the axis. Default: the mean of the vertices, or the origin of the
        `to_world` frame.
    vertices : indices of the vertices that move. Default: all.

    Raises
    ------
    ValueError : the key is unknown or has no derivative, or numbers are missing, too many, or not finite.
    """

    def __init__(
        self,
        scene: mi.Scene,
        key: str,
        *,
        direction: Sequence[float] | None = None,
        rotate: Sequence[float] | None = None,
        pivot: Sequence[float] | None = None,
        vertices: Sequence[int] | None = None,
    ):
        self.params = mi.traverse(scene)
        key = present_key(self.params, key)
        if key not in self.params:
            raise InputError(no_parameter(self.params, key))
        if (direction is None) == (rotate is None):
            raise InputError(f'"{key}": give either a direction or an axis to rotate about')
        value = self.params[key]
        self.key = key
        self.is_positions = is_positions_key(key)
        self.is_transform = key.endswith("to_world")
        self.is_tensor = dr.is_tensor_v(value)
        if not (self.is_positions or self.is_transform or (dr.is_diff_v(value) and dr.is_float_v(value))):
            raise InputError(f'"{key}" is of type {type(value).__name__}, which has no derivative')
        if rotate is not None and not (self.is_positions or self.is_transform):
            raise InputError(f'"{key}" cannot rotate: it is neither vertex positions nor a transformation')
        if vertices is not None and not self.is_positions:
            raise InputError(f'"{key}" has no vertices to choose from')

        self.initial = type(value)(dr.detach(value))
        # Where positions are set, Mitsuba makes the normals of vertices anew.
        normals = key.removesuffix("positions") + "normals"
        self.normals = {k: type(self.params[k])(dr.detach(self.params[k])) for k in [normals] if k in self.params}
        geometric = self.is_positions or self.is_transform
        size = 3 if geometric else dr.prod(dr.shape(value))
        self.direction = (
            None if direction is None else _numbers(key, "direction", direction, {size} if geometric else {1, size})
        )
        self.rotate = None if rotate is None else _numbers(key, "axis", rotate, {3})
        if self.rotate is not None and not np.any(self.rotate):
            raise InputError(f'"{key}": the axis of rotation is zero')
        self.pivot = None if pivot is None else _numbers(key, "pivot", pivot, {3})
        self.moves = None
        if self.is_positions:
            p = np.array(self.initial).reshape(-1, 3)
            chosen = np.arange(len(p)) if vertices is None else np.asarray(vertices, dtype=np.int64)
            if len(chosen) == 0 or chosen.min() < 0 or chosen.max() >= len(p):
                raise InputError(f'"{key}": vertices must be in 0 … {len(p) - 1}, got {list(chosen)}')
            self.moves = np.zeros(len(p), np.float32)
            self.moves[chosen] = 1
            if self.pivot is None:
                self.pivot = p[chosen].mean(0)
        elif self.is_transform and self.pivot is None:
            self.pivot = np.array(mi.ScalarTransform4f(self.initial.matrix.numpy().reshape(4, 4)) @ mi.ScalarPoint3f(0))

    @property
    def unit(self) -> str:
        """Unit of θ."""
        if self.rotate is not None:
            return "radian"
        return "scene unit" if self.is_positions or self.is_transform else "unit"

    def __str__(self) -> str:
        numbers = lambda a: "(" + _shown([f"{x:g}" for x in a]) + ")"
        how = f"along {numbers(self.direction)}" if self.rotate is None else f"about {numbers(self.rotate)}"
        if self.moves is None or self.moves.all():
            return f"{self.key} {how}"
        return f"{self.key} {how}, vertices {_shown([str(i) for i in np.flatnonzero(self.moves)])}"

    def apply(self, theta: mi.Float | float) -> None:
        """Set the parameter to p(θ) and update the scene; attached if `theta` is."""
        theta = mi.Float(theta)
        if self.is_positions:
            p = dr.unravel(mi.Point3f, self.initial.array if self.is_tensor else self.initial)
            moved = self._transform(theta) @ p
            moved = dr.ravel(dr.select(mi.Float(self.moves) > 0, moved, p))
            value = type(self.initial)(moved, self.initial.shape) if self.is_tensor else moved
        elif self.is_transform:
            value = self._transform(theta) @ self.initial
        else:
            kind, step = type(self.initial), theta * mi.Float(self.direction)
            if self.is_tensor:
                value = kind(self.initial.array + step, self.initial.shape)
            elif dr.size_v(self.initial) > 1:
                value = dr.unravel(kind, dr.ravel(self.initial) + step)
            else:
                value = kind(self.initial + step)
        self.params[self.key] = value
        self.params.update()

    def restore(self) -> None:
        """Leave the scene as it was: the parameter, and of a mesh that moved also the normals of its vertices."""
        for values in ({self.key: self.initial}, self.normals):
            for key, value in values.items():
                self.params[key] = type(value)(value)
            self.params.update()

    def _transform(self, theta: mi.Float) -> mi.AffineTransform4f:
        T = mi.Transform4f
        if self.rotate is None:
            assert self.direction is not None
            return T().translate(theta * _vector(self.direction))
        assert self.pivot is not None
        axis, pivot = _vector(self.rotate / np.linalg.norm(self.rotate)), _vector(self.pivot)
        return T().translate(pivot) @ T().rotate(axis, dr.rad2deg(theta)) @ T().translate(-pivot)


@no_collection()
def derivative_image(
    scene: mi.Scene, integrator: mi.Integrator, motion: Motion, *, sensor: int | mi.Sensor = 0, spp: int, seed: int = 0
) -> mi.TensorXf:
    """Derivative of the rendered image with respect to θ at θ = 0, in forward mode: (H, W, C), linear, per
    `motion.unit`.

    The scene is left as it was at the construction of `motion`. Works with every differentiable integrator of Mitsuba.
    """
    theta = mi.Float(0)
    dr.enable_grad(theta)
    try:
        motion.apply(theta)
        dr.forward(theta, dr.ADFlag.ClearEdges)
        image = integrator.render_forward(scene, motion.params, sensor=sensor, seed=seed, spp=spp)
        dr.eval(image)
    finally:
        motion.restore()
    return image


def _shown(values: Sequence[str]) -> str:
    """The entries of a list; of a long one, the first and how many there are."""
    if len(values) <= SHOWN:
        return ", ".join(values)
    return ", ".join([*values[:SHOWN], f"... of {len(values)}"])


def _vector(a: np.ndarray) -> mi.Vector3f:
    return mi.Vector3f(*map(float, a))


def _numbers(key: str, what: str, values: Sequence[float], sizes: set[int]) -> np.ndarray:
    a = np.asarray(values, dtype=np.float32).reshape(-1)
    if a.size not in sizes:
        raise InputError(f'"{key}": the {what} needs {" or ".join(map(str, sorted(sizes)))} numbers, got {a.size}')
    if not np.isfinite(a).all():
        raise InputError(f'"{key}": the {what} must be finite, got {list(map(float, a))}')
    return a
