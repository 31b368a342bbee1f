"""Tables of the MERL database: isotropic reflectance, measured by half and difference angle (Matusik et al. 2003).

A table is an array (90, 90, 180, 3): the reflectance f (no cosine) in 1/sr, linear RGB, at the angles of `angles`:
θ_h, θ_d and φ_d of Rusinkiewicz 1998. Directions are NumPy arrays (..., 3) of unit length in the shading frame, with
the normal +z::

    table = merl_tables.read_merl("gray-plastic.binary")
    merl_tables.write_merl("darker.binary", 0.5 * table)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rimlight.edge_sampling.refusals import InputError
from rimlight.exr import replacing

#: Numbers of θ_h, θ_d, φ_d and colours.
SHAPE = 90, 90, 180, 3

#: Of the numbers in a file, for red, green and blue.
SCALE = np.array([1.0, 1.15, 1.66]) / 1500

#: Degrees above the horizon below which a negative number is no damage. The published tables mark with -1 what was not
#: measured; their 1,105,588 other entries are about, but not exactly, those above the horizon.
GRAZING = 5.0


def read_merl(path: Path | str) -> np.ndarray:
    """Read a file of the database.

    Returns
    -------
    (90, 90, 180, 3), float64, 1/sr, at least 0: numbers below 0 are read as 0.

    Raises
    ------
    ValueError : the file is of another size or shape; numbers are not finite, or negative where both directions are
        more than 5 degrees above the horizon.
    FileNotFoundError
    """
    who = f"merl: {path}"
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise FileNotFoundError(f"{who}: there is no such file") from None
    header, count = 3 * 4, int(np.prod(SHAPE))
    shape = tuple(np.frombuffer(data[:header], "<i4").tolist()) if len(data) >= header else ()
    if shape and shape != SHAPE[:3]:
        raise InputError(
            f"{who}: expected 90 × 90 × 180 angles, got {' × '.join(map(str, shape))}; "
            "it is no MERL table, or one of another resolution, which must be resampled"
        )
    if len(data) != header + 8 * count:
        raise InputError(f"{who}: expected {header + 8 * count} bytes, got {len(data)}; fetch or copy the file again")
    stored = np.frombuffer(data, "<f8", offset=header).reshape(3, *SHAPE[:3])
    table = np.ascontiguousarray(np.moveaxis(stored, 0, -1)) * SCALE
    check(table, who, "fetch or copy the file again")
    return np.maximum(table, 0)


def write_merl(path: Path | str, table: np.ndarray) -> None:
    """Write a file that `read_merl` reads. There never is half a file.

    table : (90, 90, 180, 3), 1/sr; below the horizon, numbers may be negative.

    Raises
    ------
    ValueError : the table is of another shape; numbers are not finite, or negative above the horizon.
    OSError : the file cannot be written.
    """
    table = np.asarray(table, np.float64)
    check(table, f"merl: {path}", "not written")
    with replacing(path) as temporary:
        header = np.array(SHAPE[:3], "<i4").tobytes()
        temporary.write_bytes(header + np.moveaxis(table / SCALE, -1, 0).astype("<f8").tobytes())


def check(table: np.ndarray, who: str, remedy: str) -> None:
    """Refuse what is no table.

    who, remedy : begin and end of the message.

    Raises
    ------
    ValueError : the shape is not (90, 90, 180, 3); numbers are not finite, or negative where both directions are more
        than 5 degrees above the horizon.
    """
    if table.shape != SHAPE:
        raise InputError(f"{who}: expected a table of shape {SHAPE}, got {table.shape}; {remedy}")
    for what, bad in (
        ("finite numbers", ~np.isfinite(table)),
        ("numbers >= 0 above the horizon", (table < 0) & (elevation() > np.radians(GRAZING))[..., None]),
    ):
        if bad.any():
            first = tuple(int(i) for i in np.unravel_index(bad.argmax(), SHAPE))
            raise InputError(f"{who}: expected {what}, got {table[first]:g} at {first}, {bad.sum()} in all; {remedy}")


# ---------------------- Angles ----------------------


def angles() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles of the entries: θ_h (90,), denser near 0; θ_d (90,); φ_d (180,). Radians, in [0, π/2] and [0, π]."""
    centres = [(np.arange(n) + 0.5) / n for n in SHAPE[:3]]
    return np.pi / 2 * centres[0] ** 2, np.pi / 2 * centres[1], np.pi * centres[2]


def elevation() -> np.ndarray:
    """Of the lower of the two directions of each entry above the horizon: (90, 90, 180), radians, negative below."""
    theta_h, theta_d, phi_d = np.meshgrid(*angles(), indexing="ij", sparse=True)
    return np.arcsin(np.cos(theta_h) * np.cos(theta_d) - np.abs(np.sin(theta_h) * np.sin(theta_d) * np.cos(phi_d)))


def half_difference(wi: np.ndarray, wo: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Half and difference angles (Rusinkiewicz 1998), the same for exchanged directions.

    wi, wo : (..., 3), shading frame, unit length.

    Returns
    -------
    theta_h : (...), radians, in [0, π/2] above the horizon: angle from the normal to the half vector.
    theta_d : (...), radians, in [0, π/2]: angle from the half vector to either direction.
    phi_d : (...), radians, in [0, π]: azimuth of `wi`, or of `wo`, about the half vector. 0 is away from the normal.
    """
    s, e = np.asarray(wi, float) + wo, np.asarray(wi, float) - wo
    length = np.linalg.norm(s, axis=-1)
    theta_h = np.arctan2(np.hypot(s[..., 0], s[..., 1]), s[..., 2])
    theta_d = np.arctan2(np.linalg.norm(e, axis=-1), length)
    # e is at right angles to s: its parts in the frame of the half vector, but for a common factor
    x, y = -e[..., 2] * length, e[..., 1] * s[..., 0] - e[..., 0] * s[..., 1]
    turn = np.where((y < 0) | ((y == 0) & (x < 0)), -1, 1)
    return theta_h, theta_d, np.arctan2(turn * y + 0.0, turn * x)


def directions(theta_h: np.ndarray, theta_d: np.ndarray, phi_d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions with these angles, and with a half vector of azimuth 0. Inverse of `half_difference`.

    theta_h, theta_d, phi_d : radians, of shapes that can be broadcast to one.

    Returns
    -------
    wi, wo : (..., 3), shading frame, unit length; one of them may lie below the horizon.
    """
    theta_h, theta_d, phi_d = np.broadcast_arrays(theta_h, theta_d, phi_d)
    along, x, y = np.cos(theta_d), np.sin(theta_d) * np.cos(phi_d), np.sin(theta_d) * np.sin(phi_d)
    sin, cos = np.sin(theta_h), np.cos(theta_h)
    wi, wo = (np.stack([sin * along + sign * cos * x, sign * y, cos * along - sign * sin * x], -1) for sign in (1, -1))
    return wi, wo
