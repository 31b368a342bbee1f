"""A teapot, sand in dunes, and a bent sheet, for the fits `pot_in_mirror`, `box_in_sand` and `caustic`.

    python -m rimlight.scenes.make_meshes

writes `meshes/teapot.ply`, `meshes/sand.ply` and `meshes/sheet.ply`, which are part of the project.
"""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np

#: Silhouette of pot and lid, from the axis below to the axis above: radius and height.
PROFILE = (
    *((0.0, 0.0), (0.35, 0.0), (0.62, 0.08), (0.78, 0.24), (0.82, 0.42), (0.76, 0.6), (0.62, 0.76), (0.5, 0.84)),
    *((0.36, 0.91), (0.18, 0.96), (0.08, 1.0), (0.11, 1.08), (0.07, 1.15), (0.0, 1.17)),
)

#: Centres and radii along the spout and the handle, both of which begin and end within the pot or in a point.
SPOUT = (
    (0.6, 0.3, 0.2),
    (0.85, 0.36, 0.17),
    (1.0, 0.52, 0.12),
    (1.1, 0.7, 0.09),
    (1.25, 0.84, 0.08),
    (1.27, 0.86, 0.0),
)
HANDLE = (
    *((-0.55, 0.68, 0.05), (-0.85, 0.76, 0.06), (-1.1, 0.72, 0.06), (-1.24, 0.58, 0.06), (-1.2, 0.4, 0.06)),
    *((-1.05, 0.28, 0.06), (-0.85, 0.22, 0.06), (-0.6, 0.2, 0.05)),
)


def turned(profile: tuple[tuple[float, float], ...], around: int) -> tuple[np.ndarray, np.ndarray]:
    """A profile turned around the y axis. Vertices (V, 3), faces (F, 3) whose normals point outwards."""
    rings = [((0.0, y, 0.0), (r, 0.0, 0.0), (0.0, 0.0, r)) for r, y in profile]
    return skin(rings, around)


def tube(path: tuple[tuple[float, float, float], ...], around: int) -> tuple[np.ndarray, np.ndarray]:
    """A tube in the plane z = 0 along points x, y with radii. As `turned`."""
    p = np.array(path)
    along = np.gradient(p[:, :2], axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    rings = [((x, y, 0.0), (r * t[1], -r * t[0], 0.0), (0.0, 0.0, r)) for (x, y, r), t in zip(p, along, strict=True)]
    return skin(rings, around)


def skin(rings: list, around: int) -> tuple[np.ndarray, np.ndarray]:
    """Through ellipses with a centre and two half axes, one after the other."""
    angle = np.arange(around) * 2 * np.pi / around
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    points = np.array([np.array(o) + c * np.array(a) + s * np.array(b) for o, a, b in rings]).reshape(-1, 3)
    i = np.arange(len(rings) * around).reshape(len(rings), around)
    a, b = i[:-1].ravel(), np.roll(i[:-1], -1, 1).ravel()
    quads = np.stack([a, b, a + around, b + around], 1)
    faces = np.concatenate([quads[:, [0, 2, 1]], quads[:, [1, 2, 3]]])
    # Of rings without extent, one point is left, and no face.
    places, inverse = np.unique(points.round(6), axis=0, return_inverse=True)
    faces = inverse.ravel()[faces]
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return places, faces[distinct]


def teapot() -> tuple[np.ndarray, np.ndarray]:
    """A pot with a lid, a spout and a handle, which cut through it; closed surfaces."""
    parts = [turned(PROFILE, 32), tube(SPOUT, 12), tube(HANDLE, 12)]
    first = np.cumsum([0, *(len(p) for p, _ in parts)])
    return np.concatenate([p for p, _ in parts]), np.concatenate(
        [f + k for (_, f), k in zip(parts, first, strict=False)]
    )


def sand(size: int = 32) -> tuple[np.ndarray, np.ndarray]:
    """Dunes over the square from -3 to 3."""
    x, z = (a.ravel() for a in np.meshgrid(*[np.linspace(-3, 3, size + 1)] * 2))
    y = 0.09 * np.sin(2.1 * x + 0.8 * z) + 0.05 * np.sin(1.3 * x - 2.9 * z + 1) + 0.03 * np.cos(4.3 * z + 0.5 * x)
    i = np.arange((size + 1) ** 2).reshape(size + 1, size + 1)
    a, b, c, d = (k.ravel() for k in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    return np.stack([x, y, z], 1), np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])


def sheet(size: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Half of an elliptic ring, upright, with two bends."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, size + 1)
    x, z = 0.5 * np.sin(angle), 0.4 * np.cos(angle) + 0.015 * np.sin(4 * angle)
    points = np.concatenate([np.stack([x, np.full_like(x, y), z], 1) for y in (0.02, 0.3)])
    a = np.arange(size)
    b, c, d = a + 1, a + size + 1, a + size + 2
    return points, np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def write(folder: Path) -> None:
    for name, (points, faces) in {"teapot": teapot(), "sand": sand(), "sheet": sheet()}.items():
        mesh = mi.Mesh(name, len(points), len(faces))
        params = mi.traverse(mesh)
        params["vertex_positions"] = np.ascontiguousarray(points, np.float32).ravel()
        params["faces"] = np.ascontiguousarray(faces, np.uint32).ravel()
        params.update()
        mesh.write_ply(str(folder / f"{name}.ply"))


if __name__ == "__main__":
    import rimlight  # noqa: F401

    mi.set_variant("llvm_ad_rgb")
    write(Path(__file__).parent / "meshes")
