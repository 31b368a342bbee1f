"""Arrays of floats in fewer bytes, for networks and checkpoints: quick, and without loss."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

#: Arrays of fewer numbers are not packed.
WORTH = 1000


@dataclass(frozen=True)
class Packed:
    """An array without its zeros, such as the texels that no view sees, and with the highest byte of its numbers, sign
    and exponent, compressed: nothing is lost.

    places : one bit for each number that is not 0, compressed. highest : bytes of these, compressed. others : (bytes of
    a number − 1, numbers).
    """

    shape: tuple[int, ...]
    kind: np.dtype
    places: bytes
    highest: bytes
    others: np.ndarray


def pack(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Arrays, for a journey or a file. Short ones, and those of other numbers than floats, stay as they are."""
    worth = lambda array: array.size >= WORTH and array.dtype.kind == "f"
    return {key: _packed(array) if worth(array) else array for key, array in arrays.items()}


def unpack(arrays: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The inverse of `pack`."""
    return {key: _unpacked(array) if isinstance(array, Packed) else array for key, array in arrays.items()}


def _packed(array: np.ndarray) -> Packed:
    kind = array.dtype.newbyteorder("<")
    flat = array.astype(kind).ravel()
    places = flat != 0
    planes = flat[places].view(np.uint8).reshape(-1, kind.itemsize).T
    compress = lambda part: zlib.compress(part.tobytes(), 1)
    return Packed(array.shape, kind, compress(np.packbits(places)), compress(planes[-1]), planes[:-1].copy())


def _unpacked(packed: Packed) -> np.ndarray:
    whole = np.zeros(np.prod(packed.shape, dtype=int), packed.kind)
    bits = np.frombuffer(zlib.decompress(packed.places), np.uint8)
    planes = np.concatenate([packed.others, [np.frombuffer(zlib.decompress(packed.highest), np.uint8)]])
    numbers = np.ascontiguousarray(planes.T).view(packed.kind).ravel()
    whole[np.unpackbits(bits, count=whole.size).astype(bool)] = numbers
    return whole.reshape(packed.shape)
