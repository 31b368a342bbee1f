"""Regularisers: what is added to the loss because of the parameters alone, whatever the pictures say.

A regulariser is a function of scene parameters, key -> value, as `mi.traverse(scene)` has them and attached to what is
fitted. It returns one number of Dr.Jit. Give them to `Fit(…, regularisers=[…])`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.geometry.meshes import points
from rimlight.edge_sampling.refusals import InputError

#: Scene parameters, key -> value, attached -> one number.
Regulariser = Callable[[Mapping[str, Any]], Any]


def smooth_texture(key: str, strength: float) -> Regulariser:
    """Texels like their neighbours: `strength` times the mean of their squared differences.

    key : of a texture, (H, W, C), such as "wall.bsdf.reflectance.data".
    """

    def penalty(values: Mapping[str, Any]) -> mi.Float:
        texture = values[key]
        pairs = (texture[1:] - texture[:-1], texture[:, 1:] - texture[:, :-1])
        return strength * sum((dr.mean(dr.square(pair.array)) for pair in pairs if pair.array.shape[0]), mi.Float(0))

    return penalty


def smooth_mesh(key: str, faces: Any, strength: float) -> Regulariser:
    """Vertices near the middle of their neighbours: `strength` times the mean of their squared distances from it, in
    scene units squared (the uniform Laplacian of Sorkine 2005).

    key : such as "body.vertex_positions". faces : (F, 3) or flat, numbers of vertices: `params["body.faces"]`; of
        positions in Mitsuba 3.10: `mesh.geometric_faces()`.
    """
    triangles = np.array(faces, np.uint32).reshape(-1, 3)
    ends = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    ends = np.unique(np.sort(ends, axis=1), axis=0)
    ends = np.concatenate([ends, ends[:, ::-1]])
    i, j = (mi.UInt(np.ascontiguousarray(column)) for column in ends.T)
    share = mi.Float(1 / np.maximum(np.bincount(ends[:, 0]), 1)[ends[:, 0]].astype(np.float32))

    def penalty(values: Mapping[str, Any]) -> mi.Float:
        place = points(values[key])
        towards = share * (dr.gather(mi.Point3f, place, j) - dr.gather(mi.Point3f, place, i))
        squares = mi.Float(0)
        for component in towards:
            offset = dr.zeros(mi.Float, dr.width(place))
            dr.scatter_add(offset, component, i)
            squares += dr.square(offset)
        return strength * dr.mean(squares)

    return penalty


def prior(key: str, mean: Any, spread: float, strength: float = 1.0) -> Regulariser:
    """Numbers near what is expected: `strength` times the mean of ((x − mean) / spread)², of a normal distribution.

    mean : one number, or as many as the parameter has. spread : standard deviation, in the unit of the parameter.
    """
    expected = np.asarray(mean, np.float32).ravel()

    def penalty(values: Mapping[str, Any]) -> mi.Float:
        value = values[key]
        flat = value.array if dr.is_tensor_v(value) else dr.ravel(value)
        return strength * dr.mean(dr.square((flat - mi.Float(expected)) / spread))

    return penalty


def penalty_of(regularisers: Sequence[Regulariser], attached: Mapping[str, Any]) -> Any:
    """Their sum, attached to the values, or None if there are none. InputError : one cannot say it."""
    if not regularisers:
        return None
    try:
        parts = [regularise(attached) for regularise in regularisers]
    except KeyError as error:
        free = ", ".join(attached)
        raise InputError(f"fit: a regulariser asks for {error}, which is not free; free are {free}") from None
    if strange := [type(part).__name__ for part in parts if not dr.is_diff_v(part)]:
        raise InputError(f"fit: a regulariser must return a number of Dr.Jit, which has a derivative, got {strange[0]}")
    return sum((dr.sum(part.array if dr.is_tensor_v(part) else part) for part in parts), mi.Float(0))
