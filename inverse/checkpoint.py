"""Checkpoints: one NumPy archive, arrays and a JSON text, without pickles; complete or not there."""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rimlight.edge_sampling.refusals import InputError
from rimlight.exr import replacing

from .packing import Packed, pack, unpack

#: Of the file's layout.
VERSION = 4


def save(path: Path, arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> None:
    """Write a checkpoint in place of the last one, which stays until this one is complete.

    arrays : name -> array of numbers. facts : whatever JSON can say.

    Raises
    ------
    OSError : it cannot be written. The last one is still there.
    """
    packed = pack({name: np.asanyarray(array) for name, array in arrays.items()})
    layout = {name: (part.shape, part.kind.str) for name, part in packed.items() if isinstance(part, Packed)}
    parts = {"facts": np.array(json.dumps({**facts, "version": VERSION, "packed": layout}))}
    for name, part in packed.items():
        if isinstance(part, Packed):
            parts |= {f"places/{name}": _bytes(part.places), f"highest/{name}": _bytes(part.highest)}
        parts[f"array/{name}"] = part.others if isinstance(part, Packed) else part
    with replacing(path) as temporary, temporary.open("wb") as file:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, part in parts.items():
                entry = zipfile.ZipInfo(f"{name}.npy")
                # What is packed has little left to compress, and takes most of the time.
                entry.compress_type = zipfile.ZIP_STORED if name.partition("/")[2] in layout else zipfile.ZIP_DEFLATED
                with archive.open(entry, "w", force_zip64=True) as place:
                    np.lib.format.write_array(place, np.asanyarray(part), allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())


def _bytes(compressed: bytes) -> np.ndarray:
    return np.frombuffer(compressed, np.uint8)


def load(path: Path, who: str = "fit") -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and facts of a checkpoint. who : speaks in messages.

    Raises
    ------
    ValueError : the file is damaged, or none of ours.
    OSError : it cannot be read.
    """
    try:
        with zipfile.ZipFile(path) as archive:  # NumPy looks at no checksum of what it reads to the last number
            if damaged := archive.testzip():
                raise zipfile.BadZipFile(f"its part {damaged}")
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            facts = json.loads(str(file["facts"]))
            parts = {name: file[name] for name in file.files}
            arrays = {name.removeprefix("array/"): part for name, part in parts.items() if name.startswith("array/")}
            for name, (shape, kind) in facts.get("packed", {}).items():
                of_bits = parts[f"places/{name}"].tobytes(), parts[f"highest/{name}"].tobytes()
                arrays[name] = Packed(tuple(shape), np.dtype(kind), *of_bits, arrays[name])
            arrays = unpack(arrays)
    except FileNotFoundError:
        raise FileNotFoundError(f'{who}: there is no checkpoint "{path}" to resume from') from None
    except (ValueError, KeyError, EOFError, OSError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f'{who}: "{path}" is no checkpoint, or damaged: {error}') from None
    if facts.get("version") != VERSION:
        raise InputError(f'{who}: "{path}" has the layout {facts.get("version")}, this program writes {VERSION}')
    return arrays, facts
