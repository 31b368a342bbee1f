"""Depth from normals: against surfaces whose depth is known."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import NamedTuple

import mitsuba as mi
import numpy as np
import pytest

from rimlight.inverse.photometric_stereo import integration, laplacian
from rimlight.inverse.photometric_stereo.integration import depth_error, integrate, mesh_of, normals_of

# ------------------------------------------------------------------ surfaces


class Surface(NamedTuple):
    """normals : (H, W, 3). depth : (H, W), as `integrate` has it but for offset or scale. mask : (H, W)."""

    normals: np.ndarray
    depth: np.ndarray
    mask: np.ndarray
    camera: np.ndarray | None
    pixel_size: float

    def options(self) -> dict:
        return {"camera": self.camera, "pixel_size": self.pixel_size}

    def error(self, **options) -> float:
        found = integrate(self.normals, self.mask, **self.options(), **options)
        return depth_error(found, self.depth, self.mask, align="offset" if self.camera is None else "scale")


def square(size: int) -> tuple[np.ndarray, np.ndarray, float]:
    """x to the right and y up, (size, size), in [-1, 1]; and the side of a pixel."""
    pixel = 2 / size
    v, u = np.mgrid[:size, :size]
    return (u + 0.5) * pixel - 1, 1 - (v + 0.5) * pixel, pixel


def height_field(size: int, height: Callable, slopes: Callable, inside: Callable = lambda x, y: x > -2) -> Surface:
    """An orthographic view of z = height(x, y), of the slopes (∂z/∂x, ∂z/∂y)."""
    x, y, pixel = square(size)
    mask = inside(x, y)
    x, y = np.where(mask, x, 0), np.where(mask, y, 0)
    p, q = np.broadcast_arrays(*slopes(x, y), x)[:2]
    normals = np.stack([-p, -q, np.ones_like(x)], 2) / np.sqrt(1 + p**2 + q**2)[..., None]
    normals[~mask] = np.nan  # what is outside must not count
    return Surface(normals, np.where(mask, height(x, y), np.nan), mask, None, pixel)


def plane(size: int) -> Surface:
    return height_field(size, lambda x, y: 0.7 * x - 1.3 * y, lambda x, y: (0.7, -1.3))


def waves(size: int) -> Surface:
    slopes = lambda x, y: (0.6 * np.cos(3 * x) * np.cos(2 * y), -0.4 * np.sin(3 * x) * np.sin(2 * y))
    return height_field(size, lambda x, y: 0.2 * np.sin(3 * x) * np.cos(2 * y), slopes)


def cap(size: int) -> Surface:
    """Of a unit sphere, off centre, down to 53 degrees."""
    z = lambda x, y: np.sqrt(1 - (x - 0.1) ** 2 - (y + 0.05) ** 2)
    inside = lambda x, y: (x - 0.1) ** 2 + (y + 0.05) ** 2 < 0.64
    return height_field(size, z, lambda x, y: ((0.1 - x) / z(x, y), (-0.05 - y) / z(x, y)), inside)


def seen(size: int, hit: Callable) -> Surface:
    """A perspective view, with a camera that has different focal lengths, skew, and a principal point off the centre.

    hit : of rays (H, W, 3) with z = -1: depth (NaN: no hit), and normals.
    """
    K = np.array([[1.8 * size, 0.05 * size, 0.45 * size], [0, 2.1 * size, 0.55 * size], [0, 0, 1]])
    v, u = np.mgrid[:size, :size]
    rays = np.linalg.solve(K, np.stack([u, v, np.ones_like(u)]).reshape(3, -1).astype(float)).T * [1, -1, -1]
    depth, normals = hit(rays.reshape(size, size, 3))
    return Surface(normals, depth, np.isfinite(depth), K, 1.0)


def seen_plane(size: int) -> Surface:
    n = np.array([0.3, -0.4, np.sqrt(0.75)])
    return seen(size, lambda r: (-5 * n[2] / (r @ n), np.broadcast_to(n, r.shape)))


def seen_sphere(size: int) -> Surface:
    centre = np.array([0.2, -0.1, -6.0])

    def hit(r: np.ndarray):
        a, b, c = np.sum(r * r, 2), r @ centre, centre @ centre - 1
        with np.errstate(invalid="ignore"):
            d = (b - np.sqrt(b**2 - a * c)) / a
        normals = d[..., None] * r - centre
        cosine = -np.sum(normals * r, 2) / np.sqrt(a)
        return np.where(cosine > 0.5, d, np.nan), normals

    return seen(size, hit)


def occlusion(size: int) -> Surface:
    """A ball in front of another, orthographic: they meet on one side, the near one hides the far one on the other."""
    x, y, pixel = square(size)
    height, normals = np.full(x.shape, -np.inf), np.full((*x.shape, 3), np.nan)
    for centre, radius in (((-0.3, 0, 0.6), 0.45), ((0.2, 0, 0), 0.75)):
        squared = radius**2 - (x - centre[0]) ** 2 - (y - centre[1]) ** 2
        z = np.where(squared > 0, centre[2] + np.sqrt(np.maximum(squared, 1e-9)), -np.inf)
        normals = np.where((z > height)[..., None], np.stack([x, y, z], 2) - centre, normals)
        height = np.maximum(z, height)
    return Surface(normals, height, np.isfinite(height), None, pixel)


# ------------------------------------------------------------------ accuracy


def test_planes_and_spheres_are_exact() -> None:
    """Spheres are, thanks to the weights n_z: the mean slope of neighbours becomes (x + x') / (z + z')."""
    assert plane(24).error() < 1e-9
    assert plane(24).error(bilateral=2) < 1e-9
    assert cap(24).error() < 1e-9
    assert cap(24).error(weights=np.ones((24, 24))) > 1e-4


@pytest.mark.parametrize("surface", [waves, seen_plane, seen_sphere], ids=lambda f: f.__name__)
def test_errors_fall_with_the_square_of_the_size_of_pixels(surface: Callable[[int], Surface]) -> None:
    coarse, fine = surface(32).error(), surface(64).error()
    assert fine < 5e-4
    assert coarse / fine > 3


@pytest.mark.parametrize("surface", [waves, cap, seen_sphere], ids=lambda f: f.__name__)
def test_bilateral_weights_keep_smooth_surfaces(surface: Callable[[int], Surface]) -> None:
    assert surface(64).error(bilateral=2) < 2.5e-3


def test_depth_of_an_orthographic_camera() -> None:
    """Towards the camera, in the unit of the size of pixels, of mean 0, NaN outside; no matter how long normals are."""
    surface = cap(32)
    lengths = np.random.default_rng(0).uniform(0.5, 2, (32, 32, 1))
    depth = integrate(surface.normals * lengths, surface.mask, pixel_size=surface.pixel_size)
    assert depth.dtype == np.float64
    assert np.array_equal(np.isnan(depth), ~surface.mask)
    assert np.mean(depth[surface.mask]) == pytest.approx(0, abs=1e-12)
    expected = surface.depth - np.mean(surface.depth[surface.mask])
    np.testing.assert_allclose(depth[surface.mask], expected[surface.mask], atol=2e-3)
    assert np.ptp(expected[surface.mask]) > 0.3
    in_pixels = integrate(surface.normals, surface.mask)
    np.testing.assert_allclose(in_pixels[surface.mask] * surface.pixel_size, depth[surface.mask], atol=1e-9)


def test_depth_of_a_perspective_camera() -> None:
    """Away from the camera, up to scale: of geometric mean 1."""
    surface = seen_sphere(32)
    depth = integrate(surface.normals, surface.mask, camera=surface.camera)
    assert np.mean(np.log(depth[surface.mask])) == pytest.approx(0, abs=1e-12)
    expected = surface.depth / np.exp(np.mean(np.log(surface.depth[surface.mask])))
    np.testing.assert_allclose(depth[surface.mask], expected[surface.mask], rtol=5e-4)
    assert np.ptp(expected[surface.mask]) > 0.05


def test_bilateral_weights_find_a_discontinuity() -> None:
    """Four times better than a continuous surface (measured: 5.6 times)."""
    surface = occlusion(128)
    plain, bilateral = surface.error(), surface.error(bilateral=2)
    assert plain > 0.03
    assert bilateral < plain / 4


def test_bilateral_weights_that_do_not_settle(caplog: pytest.LogCaptureFixture) -> None:
    surface = occlusion(24)
    with caplog.at_level(logging.WARNING):
        surface.error(bilateral=2)
        assert not caplog.records
        surface.error(bilateral=2, max_iterations=2)
    assert "still change after 2 iterations" in caplog.text


# ------------------------------------------------------------------ masks and weights


@pytest.mark.parametrize("bilateral", [None, 2.0])
def test_parts_of_the_mask_are_independent(bilateral: float | None) -> None:
    surface = waves(40)
    parts = np.zeros((3, 40, 40), bool)
    parts[0, 3:20, 2:15] = True
    parts[1, 20:38, 15:38] = True  # touches the first at a corner only
    parts[2, 5, 30] = True  # a single pixel
    together = integrate(surface.normals, parts.any(0), bilateral=bilateral)
    for part in parts:
        assert np.mean(together[part]) == pytest.approx(0, abs=1e-10)
        alone = integrate(surface.normals, part, bilateral=bilateral)
        np.testing.assert_allclose(together[part], alone[part], atol=2e-5 if bilateral else 1e-9)
    assert np.ptp(together[parts[0]]) > 1


def test_masks_of_single_rows_and_pixels() -> None:
    surface = plane(8)
    row = np.zeros((8, 8), bool)
    row[3] = True
    assert depth_error(integrate(surface.normals, row, pixel_size=surface.pixel_size), surface.depth, row) < 1e-9
    one = np.ones((1, 1), bool)
    assert integrate(np.array([[[0.6, 0, 0.8]]]), one) == [[0]]
    assert integrate(np.array([[[0.6, 0, 0.8]]]), one, camera=np.eye(3), bilateral=2) == [[1]]


def test_weights() -> None:
    """Wrong normals of no weight do no harm around them; what has no weight follows its neighbours."""
    surface = waves(48)
    wrong, weights = surface.normals.copy(), np.ones((48, 48))
    wrong[19:29, 32:40] = (0.9, 0, 0.1)
    weights[19:29, 32:40] = 0
    surface = surface._replace(normals=wrong)
    found = integrate(wrong, surface.mask, weights=weights, pixel_size=surface.pixel_size)
    assert depth_error(found, surface.depth, weights > 0) < 1e-3
    assert depth_error(found, surface.depth, surface.mask) < 2e-3
    assert surface.error(weights=np.ones((48, 48))) > 0.05


def test_parts_without_equations_stay_where_they_are() -> None:
    mask = np.ones((3, 3), bool)
    up = UP[:3, :3].reshape(9, 3)
    equations = integration._equations(mask, up, -up, np.eye(3)[:2], np.ones(9))
    q = np.arange(9.0)
    none = [np.zeros((2, 6))] * 2
    np.testing.assert_allclose(integration._least_squares(equations, none, q), q)
    first_row = [np.ones((2, 6)) * (np.arange(6) < 2), none[1]]
    flat = integration._least_squares(equations, first_row, q)
    np.testing.assert_allclose(flat, [1, 1, 1, 3, 4, 5, 6, 7, 8], atol=1e-2)


@pytest.mark.parametrize(("bilateral", "power"), [(None, 1), (2.0, 2)])
def test_weights_by_default(bilateral: float | None, power: int) -> None:
    surface = waves(24)
    noise = np.random.default_rng(0).normal(0, 0.2, surface.normals.shape)
    normals = surface.normals + noise
    normals[..., 2] = np.maximum(normals[..., 2], 0.1)
    cosine = normals[..., 2] / np.linalg.norm(normals, axis=2)
    default = integrate(normals, surface.mask, bilateral=bilateral)
    same = integrate(normals, surface.mask, bilateral=bilateral, weights=7 * cosine**power)
    other = integrate(normals, surface.mask, bilateral=bilateral, weights=cosine ** (3 - power))
    np.testing.assert_allclose(default, same, atol=1e-5)
    assert np.abs(default - other).max() > 0.05


def test_normals_that_face_away() -> None:
    """Their cosine counts as 0.02: steep slopes, in the direction that they have, of little weight."""
    normals = np.tile([-0.7, 0, 1], (24, 24, 1))
    normals[:, 12] = (1, 0, -0.5)
    right = np.diff(integrate(normals, np.ones((24, 24), bool)), axis=1)
    np.testing.assert_allclose(np.delete(right, [11, 12], axis=1), 0.7, atol=1e-6)
    cosine, weight = 1 / np.sqrt(1 + 0.7**2), 0.02  # of the plane; of the column that faces away
    slope = -(1 / np.sqrt(1.25)) / 0.02
    np.testing.assert_allclose(right[:, 11:13], (cosine * 0.7 + weight * slope) / (cosine + weight), atol=1e-6)


def test_multigrid_agrees_with_factorisation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also with a discontinuity, where weights differ by orders of magnitude, and with a ragged mask."""
    surface = occlusion(96)
    mask = surface.mask & (np.random.default_rng(0).random((96, 96)) > 0.1)
    solve = lambda: [integrate(surface.normals, mask, bilateral=b) for b in (None, 2.0)]
    direct = solve()
    monkeypatch.setattr(laplacian, "DIRECT", 100)
    for a, b in zip(direct, solve(), strict=True):
        assert 0 < np.nanmax(np.abs(a - b)) < 1e-4
        assert np.nanmax(a) > 10


def test_multigrid_says_when_it_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    surface = waves(64)
    monkeypatch.setattr(laplacian, "DIRECT", 100)
    monkeypatch.setattr(laplacian, "ITERATIONS", 1)
    with pytest.raises(RuntimeError, match="no solution within 1 iterations"):
        integrate(surface.normals, surface.mask)


# ------------------------------------------------------------------ from depth


@pytest.mark.parametrize("surface", [waves, cap, seen_plane, seen_sphere], ids=lambda f: f.__name__)
def test_normals_of(surface: Callable[[int], Surface]) -> None:
    degrees = []
    for s in (surface(32), surface(64)):
        true = s.normals / np.linalg.norm(s.normals, axis=2, keepdims=True)
        found = normals_of(s.depth, s.mask, **s.options())
        assert np.array_equal(np.isnan(found[..., 0]), ~s.mask)
        degrees.append(np.degrees(np.nanmean(np.arccos(np.clip(np.sum(true * found, 2), -1, 1)))))
    assert degrees[1] < 0.6 and degrees[1] < 0.6 * degrees[0] + 1e-4


def test_normals_of_pixels_without_neighbours() -> None:
    mask = np.zeros((4, 4), bool)
    mask[0, :3] = mask[1, 0] = True
    known = np.isfinite(normals_of(np.ones((4, 4)), mask)).all(2)
    assert known.sum() == 1 and known[0, 0]


@pytest.mark.parametrize("surface", [cap, seen_sphere], ids=lambda f: f.__name__)
def test_mesh_of(surface: Callable[[int], Surface]) -> None:
    s = surface(24)
    vertices, faces, pixels = mesh_of(s.depth, s.mask, **s.options())
    assert np.array_equal(pixels, np.argwhere(s.mask))
    v, u = pixels.T
    if s.camera is None:
        np.testing.assert_allclose(vertices, np.stack([u * s.pixel_size, -v * s.pixel_size, s.depth[v, u]], 1))
    else:
        projected = (vertices * [1, -1, -1]) @ s.camera.T
        np.testing.assert_allclose(projected[:, :2] / projected[:, 2:], np.stack([u, v], 1), atol=1e-9)
        np.testing.assert_allclose(projected[:, 2], s.depth[v, u])
    # Counter-clockwise in the picture, whose rows go down; each face half a pixel
    a, b, c = (np.stack([pixels[faces[:, k], 1], -pixels[faces[:, k], 0]], 1) for k in range(3))
    area = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    assert np.all(area == 0.5)
    blocks = s.mask[:-1, :-1].astype(int) + s.mask[1:, :-1] + s.mask[:-1, 1:] + s.mask[1:, 1:]
    assert len(faces) == 2 * np.sum(blocks == 4) + np.sum(blocks == 3)
    assert len(np.unique(np.sort(faces, axis=1), axis=0)) == len(faces)
    # Faces lie on the surface, and look as its normals do
    p, q, r = (vertices[faces[:, k]] for k in range(3))
    face_normals = np.cross(q - p, r - p)
    mean_normals = s.normals[v, u][faces].mean(1)
    cosine = np.sum(face_normals * mean_normals, 1)
    cosine /= np.linalg.norm(face_normals, axis=1) * np.linalg.norm(mean_normals, axis=1)
    assert cosine.min() > np.cos(np.radians(8))


def test_meshes_are_split_along_the_shorter_diagonal() -> None:
    full = np.ones((2, 2), bool)
    pairs = lambda depth: {tuple(sorted(f)) for f in mesh_of(np.array(depth, float), full)[1].tolist()}
    assert pairs([[0, 0], [0, 3]]) == {(0, 1, 2), (1, 2, 3)}
    assert pairs([[0, 0], [3, 0]]) == {(0, 1, 3), (0, 2, 3)}


@pytest.mark.parametrize("missing", range(4))
def test_three_pixels_make_a_triangle(missing: int) -> None:
    mask = np.ones((2, 2), bool)
    mask.flat[missing] = False
    vertices, faces, _ = mesh_of(np.zeros((2, 2)), mask)
    assert len(faces) == 1 and sorted(faces[0]) == [0, 1, 2]
    p, q, r = vertices[faces[0]]
    assert np.cross(q - p, r - p)[2] > 0


def test_meshes_are_those_of_mitsuba() -> None:
    """Rays along the view hit each vertex from the front."""
    s = cap(16)
    vertices, faces, _ = mesh_of(s.depth, s.mask, pixel_size=s.pixel_size)
    mesh = mi.Mesh("cap", len(vertices), len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"] = vertices.ravel().astype(np.float32)
    params["faces"] = faces.ravel().astype(np.uint32)
    params.update()
    scene = mi.load_dict({"type": "scene", "mesh": mesh})
    inner = vertices[faces].mean(1).astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(*inner.T[:2], 10.0), mi.Vector3f(0, 0, -1))
    hit = scene.ray_intersect(ray)
    assert np.array(hit.is_valid()).all()
    assert np.all(np.array(hit.n)[2] > 0.5)
    np.testing.assert_allclose(10 - np.array(hit.t), inner[:, 2], atol=1e-4)


def test_depth_error() -> None:
    truth = np.array([[1.0, 2, 40], [5, 6, 50]])
    mask = np.array([[True, True, True], [True, True, False]])
    assert depth_error(truth + 3, truth, mask) == pytest.approx(0, abs=1e-12)
    assert depth_error(2 * truth, truth, mask, align="scale") == pytest.approx(0, abs=1e-12)
    assert depth_error(2 * truth, truth, mask) == pytest.approx(np.abs(truth - 5)[mask].mean())
    wrong = truth * [[2, 2, 1], [2, 0.5, 1]]
    for align, change in (("offset", np.add), ("scale", np.multiply)):
        found = depth_error(wrong, truth, mask, align=align)
        scan = np.linspace(-3, 3, 6001) if align == "offset" else np.linspace(0.3, 3, 5401)
        best = min(np.abs(change(wrong, s) - truth)[mask].mean() for s in scan)
        assert found == pytest.approx(best, abs=2e-3) and found > 0.1


@pytest.mark.parametrize(
    "camera", [None, np.array([[30.0, 0, 9], [0, 30, 9], [0, 0, 1]])], ids=["orthographic", "camera"]
)
def test_depth_error_aligns_rigidly(camera: np.ndarray | None) -> None:
    """A tilted plane is a plane; of bumps, what no motion explains is left."""
    mask = np.ones((20, 20), bool)
    v, u = np.indices(mask.shape)
    level, slope = np.full(mask.shape, 20.0), 0.002 * (u - 9) + 0.001 * (v - 9)
    tilted = level + slope if camera is None else 3 * level / (1 + slope)
    usual = depth_error(tilted, level, mask, align="offset" if camera is None else "scale")
    assert depth_error(tilted, level, mask, align="rigid", camera=camera) < 0.01 * usual
    bumps = 0.1 * np.sin(2 * u) * np.sin(2 * v)
    found = depth_error(tilted * (1 + bumps / 20), level, mask, align="rigid", camera=camera)
    assert found == pytest.approx(np.abs(bumps).mean(), rel=0.05)


def test_depth_error_aligns_each_part() -> None:
    truth = np.arange(15.0).reshape(3, 5)
    mask = np.ones((3, 5), bool)
    mask[:, 2] = False
    shifted = truth + np.where(np.arange(5) < 2, 5, -1)
    assert depth_error(shifted, truth, mask) == pytest.approx(0, abs=1e-12)
    assert depth_error(shifted, truth, np.ones((3, 5), bool)) > 1


# ------------------------------------------------------------------ errors

MASK = np.ones((4, 5), bool)
UP = np.tile([0.0, 0, 1], (4, 5, 1))
NAN = np.where(np.arange(5)[None, :, None] == 2, np.nan, UP)


@pytest.mark.parametrize(
    ("normals", "mask", "options", "message"),
    [
        (UP[:3], MASK, {}, r"normals have the shape \(3, 5, 3\), not \(4, 5, 3\)"),
        (UP, np.ones((4, 5)), {}, r"the mask must be an array \(H, W\) of bool, got float64"),
        (UP, np.ones((4, 5, 3), bool), {}, r"the mask must be an array \(H, W\) of bool"),
        (UP, ~MASK, {}, "the mask is empty"),
        (NAN, MASK, {}, "4 normals in the mask are not finite, or zero; take these pixels out of the mask"),
        (0 * UP, MASK, {}, "20 normals in the mask are not finite, or zero"),
        (UP, MASK, {"camera": np.eye(4)}, "the camera must be a matrix"),
        (UP, MASK, {"camera": np.diag([1.0, -1, 1])}, "the camera must be a matrix"),
        (UP, MASK, {"pixel_size": 0}, '"pixel_size" must be positive, got 0'),
        (UP, MASK, {"weights": np.ones((5, 4))}, r"weights have the shape \(5, 4\)"),
        (UP, MASK, {"weights": -np.ones((4, 5))}, "weights in the mask must be finite, >= 0"),
        (UP, MASK, {"weights": np.zeros((4, 5))}, "not all 0"),
        (UP, MASK, {"bilateral": 0}, '"bilateral" must be positive, got 0; 2 is usual'),
        (UP, MASK, {"tolerance": np.nan}, "tolerance nan"),
        (UP, MASK, {"max_iterations": 0}, "max_iterations 0"),
    ],
)
def test_errors_of_integrate(normals, mask, options, message) -> None:
    with pytest.raises(ValueError, match=f"integrate: .*{message}"):
        integrate(normals, mask, **options)


@pytest.mark.parametrize("function", [normals_of, mesh_of])
def test_errors_of_depth(function: Callable) -> None:
    name = function.__name__
    with pytest.raises(ValueError, match=rf"{name}: depth has the shape \(3, 5\), the mask \(4, 5\)"):
        function(np.ones((3, 5)), MASK)
    with pytest.raises(ValueError, match=f"{name}: depth is not finite in 4 pixels of the mask"):
        function(NAN[..., 2], MASK)
    with pytest.raises(ValueError, match=f"{name}: depth of a perspective camera must be positive"):
        function(-np.ones((4, 5)), MASK, camera=np.eye(3))


def test_errors_of_depth_error() -> None:
    with pytest.raises(ValueError, match='"align" must be "offset", "scale" or "rigid", got "turn"'):
        depth_error(UP[..., 2], UP[..., 2], MASK, align="turn")
    with pytest.raises(ValueError, match="must be positive"):
        depth_error(UP[..., 0], UP[..., 2], MASK, align="scale")


# ------------------------------------------------------------------ a real object


def test_bear(shared) -> None:
    """The bear of DiLiGenT, true normals. Published: 1.202 mm for a continuous surface of the weights c², and 0.334 mm
    with bilateral weights; what we find with these is in docs/normal_integration.md, and why."""
    folder = shared("diligent/bear_depth")
    read = lambda name: np.array(mi.Bitmap(str(folder / name)))
    mask = read("mask.png").reshape(512, 612, -1)[..., 0] > 0
    normals = read("normal_map.png")[..., :3] / 65535.0 * 2 - 1
    truth, K = np.load(folder / "depth_gt.npz")["depth_gt"], np.loadtxt(folder / "K.txt")
    v, u = np.mgrid[:512, :612]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], -(v - K[1, 2]) / K[1, 1], -np.ones(mask.shape)], 2)
    squared = np.clip(np.sum(normals * rays, 2), None, -0.02) ** 2

    bear = Surface(normals, truth, mask, K, 1.0)
    assert bear.error(weights=squared) == pytest.approx(1.202, abs=0.005)
    assert bear.error() < 0.96
    assert bear.error(bilateral=2) < 0.49
