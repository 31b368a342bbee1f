"""Geometry, materials and scales at which arithmetic gives way: nothing may become infinite or NaN, in the image or in
its derivatives. Where the right answer is known, it must come out, too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from meshes import bumpy_sphere
from random_scenes import ball, torus

from rimlight.checks import Motion, derivative_image
from rimlight.edge_sampling import Geometry, ShadingBoundary, Silhouettes, find_edges
from rimlight.edge_sampling.boundaries.tracer import ShadingPoint
from rimlight.edge_sampling.parametrisation import Vicinity
from rimlight.transport.tracer import PathTracer

INTEGRATORS = {"direct_edge": {"type": "direct_edge"}, "prb_edge": {"type": "prb_edge", "max_depth": 4}}
SIDE = [1, 0.3, 0.2]
SPP = 4


@pytest.fixture(params=INTEGRATORS)
def integrator(request) -> Callable[..., mi.Integrator]:
    return lambda **options: mi.load_dict({**INTEGRATORS[request.param], **options})


# ---------------------- Scenes ----------------------


def camera(origin=(0.5, 2, -5), target=(0, 0.5, 0), **options) -> dict:
    return cases.camera(origin, target, film=cases.film(width=16, height=16), **options)


def stage(*things: mi.Mesh, sensor=None, **more) -> mi.Scene:
    """Things on a floor under a light, which `more` may replace."""
    objects = {
        "sensor": sensor or camera(),
        "floor": cases.horizontal((0, 0, 0), 2, "floor", bsdf=cases.diffuse(0.5, two_sided=True)),
        "light": cases.horizontal(
            (0.3, 4, 0.2), 0.5, "light", down=True, bsdf=cases.diffuse(0.0), emitter=cases.light(20, 18, 16)
        ),
        **{m.id(): m for m in things},
        **more,
    }
    return cases.scene(**{name: o for name, o in objects.items() if o is not None})


def thing(vertices, faces, normals: bool = False, bsdf=None) -> mi.Mesh:
    return cases.mesh("thing", vertices, faces, normals, bsdf=bsdf or cases.diffuse(0.6, 0.5, 0.4, two_sided=True))


def cube(bsdf=None) -> mi.Mesh:
    return thing(0.4 * cases.cube_vertices() + [0.1, 0.9, 0], cases.CUBE_FACES, bsdf=bsdf)


QUAD = [[0, 1, 2], [1, 3, 2]]
ON_AXIS = [[0, 1, -3], [0, 1, 1], [0, 1.7, -3], [0, 1.7, 1]]
NEEDLES = [[0, 0.5, 0], [1, 0.5, 0], [0.5, 0.5 + 1e-7, 0], [0.5, 1, 0], [0.2, 1, 0.3], [0.2, 1, 0.3], [0, 2, 0]]
RIM = [[np.cos(a) - 1, 1 + 0.3 * np.sin(3 * a), np.sin(a)] for a in range(5)]
PARTS = [
    # A quad that stands on the floor: its lower edge lies in the floor's plane, the lines of two others meet the floor.
    ([[-0.5, 0, 0], [0.5, 0, 0], [-0.5, 1, 0], [0.5, 1, 0]], QUAD),
    # One with edges along the view, or parallel to it.
    (ON_AXIS, QUAD),
    # Needles, triangles without area, or with a vertex or all of them named twice.
    (NEEDLES, [[0, 1, 2], [0, 1, 3], [0, 1, 3], [3, 4, 5], [3, 4, 6], [2, 3, 6], [0, 0, 4], [6, 1, 1]]),
    ([[0, 0.5, 0.1], [1, 0.5, 0.1], [2, 0.5, 0.1]], [[0, 1, 2]]),
    # Five faces on one edge.
    ([[-1, 0.2, 0], [-1, 1.5, 0], *RIM], [[0, 1, k] for k in range(2, 7)]),
    # Two sheets through each other and through the floor.
    ([[-0.8, -0.3, 0.4], [0.8, -0.3, 0.4], [-0.8, 1, 0.4], [0.8, 1, 0.4]], QUAD),
    ([[0.3, -0.2, -0.8], [0.3, -0.2, 0.8], [0.3, 1.2, -0.8], [0.3, 1.2, 0.8]], QUAD),
]


def hard_meshes(sensor=None, bsdf=None, **more) -> mi.Scene:
    vertices, faces = [], []
    for v, f in PARTS:
        faces += (np.array(f) + len(vertices)).tolist()
        vertices += v
    return stage(thing(vertices, faces, bsdf=bsdf), sensor=sensor, **more)


def lamp(origin, u, v) -> mi.Mesh:
    return cases.quad(origin, u, v, "light", bsdf=cases.diffuse(0.0), emitter=cases.light(5, 5, 5))


def light_in_the_floor() -> mi.Scene:
    return stage(cube(), light=lamp([-0.5, 0, -1], [0, 0, 0.5], [1, 0, 0]))


def light_on_the_floor() -> mi.Scene:
    return stage(cube(), light=lamp([-0.5, 0, 1], [0, 0.5, 0], [1, 0, 0]))


def light_in_view() -> mi.Scene:
    """It reflects, and to rounding its points see each other: exactly edge-on."""
    lamp = {"bsdf": cases.diffuse(0.5), "emitter": cases.light(20, 18, 16)}
    light = cases.horizontal((0.3, 3.9, 0.2), 1, "light", down=True, **lamp)
    return stage(cube(), sensor=camera((0.3, 2, 0), (0.3, 3.9, 0.2)), light=light)


def black() -> mi.Scene:
    none = cases.diffuse(0.0, two_sided=True)
    return hard_meshes(bsdf=none, floor=cases.horizontal((0, 0, 0), 2, "floor", bsdf=none))


def grazing() -> mi.Scene:
    """A torus with interpolated normals, seen along its top; one sphere in front of the light, one on the floor."""
    torus = cases.torus("thing", bsdf=cases.diffuse(0.6, two_sided=True))
    ball = lambda centre, radius: {"type": "sphere", "center": centre, "radius": radius, "bsdf": cases.diffuse(0.6)}
    sensor = camera((0, 0.46, -4), (0, 0.44, 0))
    return stage(torus, sensor=sensor, occluder=ball([0.3, 2.5, 0], 0.4), receiver=ball([-0.9, 0.5, 0.5], 0.5))


def glossy() -> mi.Scene:
    """Rough glass above what is almost a mirror, under a light with a texture."""
    texels = np.random.default_rng(0).uniform(0, 20, (4, 4, 3)).astype(np.float32)
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "filter_type": "bilinear"}
    light = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0.3, 4, 0.2]).rotate([1, 0, 0], 90),
        "emitter": {"type": "area", "radiance": radiance},
    }
    mirror = {"type": "roughconductor", "alpha": 1e-4}
    glass = {"type": "roughdielectric", "alpha": 0.1}
    return stage(cube(glass), light=light, floor=cases.horizontal((0, 0, 0), 2, "floor", bsdf=mirror))


def sky() -> mi.Scene:
    """A picture of the surroundings, with a small sun."""
    texels = np.random.default_rng(0).uniform(0, 2, (4, 8, 3)).astype(np.float32)
    texels[1, 3] = 100
    return stage(cube(), light=None, environment={"type": "envmap", "bitmap": mi.Bitmap(texels)})


@dataclass(frozen=True)
class Hard:
    scene: Callable[[], mi.Scene]
    key: str = "thing.vertex_positions"
    motion: dict = field(default_factory=lambda: {"direction": SIDE})


HARD = {
    "meshes": Hard(hard_meshes),
    "meshes, one point of an edge": Hard(lambda: hard_meshes(camera(target=(0.5, 0, 0), fov=1e-3))),
    "meshes, along an edge": Hard(lambda: hard_meshes(camera((0, 1, -5), (0, 1, 0)))),
    "light in the floor": Hard(light_in_the_floor, "light.vertex_positions"),
    "light on the floor": Hard(light_on_the_floor, "light.vertex_positions"),
    "light in view": Hard(light_in_view, "light.vertex_positions"),
    "light in view, brighter": Hard(light_in_view, "light.emitter.radiance.value", {"direction": [1, 0.5, 0.2]}),
    "black": Hard(black),
    "grazing, past spheres": Hard(grazing),
    "glossy": Hard(glossy),
    "sky": Hard(sky),
    "no light": Hard(lambda: stage(cube(), light=None)),
}


# ---------------------- Finite, and the same both ways ----------------------


def jacobian_times(scene, integrator, motion, seed=0, spp=SPP) -> np.ndarray:
    return np.array(derivative_image(scene, integrator, motion, spp=spp, seed=seed), float)


def gradient(scene, integrator, motion, weights) -> float:
    """dθ of Σ weights · image, through backward mode."""
    theta = mi.Float(0)
    dr.enable_grad(theta)
    motion.apply(theta)
    value = motion.params[motion.key]
    integrator.render_backward(scene, motion.params, mi.TensorXf(weights), seed=0, spp=SPP)
    dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward)
    motion.apply(0.0)
    return dr.grad(theta)[0]


def assert_finite(hard: Hard, integrator: mi.Integrator) -> None:
    """And the same derivative both ways."""
    scene = hard.scene()
    motion = Motion(scene, hard.key, **hard.motion)
    assert np.isfinite(np.array(mi.render(scene, integrator=integrator, spp=SPP))).all()
    J = jacobian_times(scene, integrator, motion)
    assert np.isfinite(J).all()
    weights = np.random.default_rng(0).uniform(0.5, 1, J.shape).astype(np.float32)
    expected = pytest.approx((weights * J).sum(), abs=1e-3 * np.abs(J).sum() + 1e-5)
    assert gradient(scene, integrator, motion, weights) == expected


@pytest.mark.parametrize("hard", HARD.values(), ids=HARD)
def test_image_and_derivatives_are_finite(hard, integrator):
    assert_finite(hard, integrator())


@pytest.mark.parametrize("hard", HARD.values(), ids=HARD)
def test_images_from_both_ends_are_finite(hard):
    image = np.array(mi.render(hard.scene(), integrator=mi.load_dict({"type": "bdpt", "max_depth": 5}), spp=SPP))
    assert np.isfinite(image).all()


def test_camera_that_moves_past_hard_meshes():
    """In forward mode: `test_direct_edge.py` has more of this."""
    scene = hard_meshes()
    motion = Motion(scene, "sensor.to_world", rotate=[0.1, 1, 0.2])
    assert np.isfinite(jacobian_times(scene, mi.load_dict(INTEGRATORS["prb_edge"]), motion)).all()


def test_points_on_the_lines_of_edges():
    """Shading points on an edge, on its end, on its line, and with the edge in their tangent plane."""
    scene = stage(thing(*PARTS[0]), light=None, environment=cases.constant())
    motion = Motion(scene, "thing.vertex_positions", direction=SIDE)
    theta = mi.Float(0)
    dr.enable_grad(theta)
    motion.apply(theta)
    dr.forward(theta, dr.ADFlag.ClearEdges)
    geometry = Geometry.of(scene)
    silhouettes = Silhouettes(geometry, find_edges(geometry), None)
    silhouettes.refit()
    shading = ShadingBoundary(scene, silhouettes, None)
    shading.refit()
    x, z, count = [-0.5, 0.5, 0, 0.25, 0.7, -2, 0.5, 0.1], [0, 0, 0, 0, 0, 0, -0.25, -0.25], 256
    target = mi.Point3f(dr.repeat(mi.Float(x), count), 0, dr.repeat(mi.Float(z), count))
    d = dr.normalize(mi.Vector3f(0, -2, 1))
    with dr.suspend_grad():
        si = scene.ray_intersect(mi.Ray3f(target - 2 * d, d))
        assert dr.all(dr.norm(si.p - target) < 1e-6)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(x) * count)
    placement = silhouettes.placement()
    integrator = mi.load_dict({"type": "prb_edge", "max_depth": 3})
    # Beyond the first vertex, where diffuse surfaces do not leave emitted light to `ShadowBoundary`.
    depth, β = dr.full(mi.UInt32, 2, len(x) * count), dr.ones(mi.Spectrum, len(x) * count)
    point = ShadingPoint(si, depth, β, mi.Bool(True), mi.Bool(False), Vicinity(mi.Float(0.5)), mi.Float(1))
    L = shading.sample(PathTracer(scene, integrator), placement, point, sampler, sampler.next_1d())
    derivative = np.array(dr.forward_to(L, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad))
    assert np.isfinite(derivative).all()
    seen = (derivative.reshape(3, len(x), count) != 0).any((0, 2))
    assert seen[-2:].all(), "the test looks at nothing"


# ---------------------- Known answers ----------------------


def boundaries_only(scene, integrator, motion, spp=64, **options) -> np.ndarray:
    return jacobian_times(scene, integrator(sppc=0, **options), motion, spp=spp)


def test_black_surfaces_have_no_boundaries_at_shading_points(integrator):
    scene = black()
    motion = Motion(scene, "thing.vertex_positions", direction=SIDE)
    assert (boundaries_only(scene, integrator, motion, sppp=0) == 0).all()


def glowing_room(normals: bool) -> tuple[mi.Scene, Motion]:
    """A sphere, as seen from its inside."""
    room = bumpy_sphere(150, bumps=0)
    vertices, faces = (np.array(b).reshape(-1, 3) for b in (room.vertex_positions_buffer(), room.faces_buffer()))
    walls = {"bsdf": cases.diffuse(0.5), "emitter": cases.light(1, 1, 1)}
    room = cases.mesh("room", vertices, faces[:, ::-1], normals, **walls)
    scene = cases.scene(sensor=camera((0.3, 0.1, -0.2), (0, 0, 1)), room=room)
    return scene, Motion(scene, "room.vertex_positions", direction=SIDE)


def test_closed_room_has_no_boundaries(integrator):
    """No edge is in view, from nowhere; and of light that is the same everywhere, the planes of two faces hide equally
    much at their edge."""
    scene, motion = glowing_room(normals=True)
    for part in ({"sppi": 0}, {"sppp": 0}):
        only = integrator(sppc=0, **part)
        assert_zero(np.array([jacobian_times(scene, only, motion, seed=i, spp=64) for i in range(16)]))


def test_closed_room_looks_the_same_from_everywhere():
    scene, motion = glowing_room(normals=False)
    integrator = mi.load_dict(INTEGRATORS["prb_edge"])
    assert_zero(np.array([jacobian_times(scene, integrator, motion, seed=i, spp=64) for i in range(16)]))


def test_energy_of_paths_from_both_ends():
    """In a closed room of albedo 0.5 whose walls glow with radiance 1, and beside a white cube under a white sky."""
    scene, _ = glowing_room(normals=False)
    for depth in (2, 4, 6):
        image = np.array(mi.render(scene, integrator=mi.load_dict({"type": "bdpt", "max_depth": depth}), spp=256))
        assert image.mean() == pytest.approx(2 - 0.5 ** (depth - 1), rel=2e-3)
    scene = cases.scene(sensor=camera((1.5, 2, -3)), thing=cube(cases.diffuse(1.0)), sky=cases.constant())
    image = np.array(mi.render(scene, integrator=mi.load_dict({"type": "bdpt", "max_depth": 8}), spp=256))
    assert image.mean() == pytest.approx(1, rel=2e-3)


def test_white_cube_under_a_white_sky_is_invisible(integrator):
    scene = cases.scene(sensor=camera((1.5, 2, -3)), thing=cube(cases.diffuse(1.0)), sky=cases.constant())
    motion = Motion(scene, "thing.vertex_positions", direction=SIDE)
    assert_zero(np.array([jacobian_times(scene, integrator(), motion, seed=i, spp=64) for i in range(16)]))


def assert_zero(images: np.ndarray) -> None:
    """Of independent runs: in every pixel, and on the whole."""
    error = images.std(0, ddof=1) / np.sqrt(len(images))
    assert np.abs(images.mean(0) / np.maximum(error, 1e-4)).max() < 5
    totals = images.sum((1, 2, 3))
    assert abs(totals.mean()) < 4 * totals.std(ddof=1) / np.sqrt(len(totals)) + 1e-3


# ---------------------- Scale ----------------------


def scaled(s: float, **on_floor: dict) -> tuple[mi.Scene, Motion]:
    """The same scene, s times as large, and the same motion in units of its size."""
    sensor = camera(s * np.array([0.5, 2, -5]), s * np.array([0, 0.5, 0]), near_clip=0.01 * s, far_clip=1e4 * s)
    lamp = {"bsdf": cases.diffuse(0.0), "emitter": cases.light(20, 18, 16)}
    scene = stage(
        thing(s * (0.4 * cases.cube_vertices() + [0.1, 0.9, 0]), cases.CUBE_FACES),
        sensor=sensor,
        floor=cases.horizontal((0, 0, 0), 2 * s, "floor", bsdf=cases.diffuse(0.5, two_sided=True), **on_floor),
        light=cases.horizontal(s * np.array([0.3, 4, 0.2]), 0.5 * s, "light", down=True, **lamp),
    )
    return scene, Motion(scene, "thing.vertex_positions", direction=s * np.array(SIDE))


def relative_difference(image: np.ndarray, reference: np.ndarray) -> float:
    return np.abs(image - reference).sum() / np.abs(reference).sum()


def mean_derivative(scene, motion, integrator) -> np.ndarray:
    return np.mean([jacobian_times(scene, integrator, motion, seed=i, spp=64) for i in range(4)], 0)


@pytest.fixture(scope="module")
def at_unit_scale(variant) -> dict[str, np.ndarray]:
    return {name: mean_derivative(*scaled(1), mi.load_dict(i)) for name, i in INTEGRATORS.items()}


@pytest.mark.parametrize("scale", [1e6, 1e-3, 1e-6])
@pytest.mark.parametrize("name", INTEGRATORS)
def test_derivatives_do_not_depend_on_the_scale(at_unit_scale, name, scale):
    """Equal seeds: what is left is due to the offset of rays from surfaces."""
    mean = mean_derivative(*scaled(scale), mi.load_dict(INTEGRATORS[name]))
    assert relative_difference(mean, at_unit_scale[name]) < 0.03


@pytest.mark.parametrize("scale", [1e6, 1e-6])
def test_film_boundary_does_not_depend_on_the_scale(scale):
    """Directly visible light alone, on which the offset of rays has no influence."""
    films = []
    for s in (1, scale):
        scene, motion = scaled(s, emitter=cases.light(1, 2, 3))
        films.append(mean_derivative(scene, motion, mi.load_dict({"type": "prb_edge", "max_depth": 1})))
    assert relative_difference(films[1], films[0]) < 0.01


def test_shadows_on_what_throws_them_in_small_scenes():
    """Points that a shadow was moved to are on the surface, also where the offset of rays is as large as its faces."""
    points, _, _, faces = torus(28)
    images = []
    for scale in (1, 1 / 300):
        description = {
            "sensor": camera(scale * np.array([0.5, 2, -5]), (0, 0, 0), near_clip=0.01 * scale),
            "thing": cases.mesh("thing", scale * points, faces, bsdf=cases.diffuse(0.5)),
            "sun": cases.sun(),
        }
        scene = cases.scene(**description)
        motion = Motion(scene, "sun.to_world", rotate=[0.3, 0.2, 1])
        images.append(mean_derivative(scene, motion, mi.load_dict({"type": "direct_edge", "sppc": 0, "sppp": 0})))
    assert np.abs(images[1]).sum() == pytest.approx(np.abs(images[0]).sum(), rel=0.1)


def test_small_scenes_give_finite_derivatives(integrator):
    """Smaller than the offset of rays from surfaces, so that these start anywhere."""
    scene, motion = scaled(1e-6)
    assert np.isfinite(jacobian_times(scene, integrator(), motion)).all()
    assert np.isfinite(gradient(scene, integrator(), motion, np.ones((16, 16, 3), np.float32)))


def test_large_scenes_give_the_same_derivative_both_ways():
    assert_finite(Hard(lambda: scaled(1e6)[0]), mi.load_dict(INTEGRATORS["direct_edge"]))


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
@pytest.mark.parametrize("gap", [2e-6, 1e-5, 1e-4])
def test_fold_beside_a_contour_counts_once(kind, gap):
    """The outer face of a black box is seen edge-on, but for `gap`: its two long edges are closer on the film than the
    rays beside them, and one of them is no silhouette."""
    vertices = [[-1, -1, 0], [0, -1, 0], [0, 1, 0], [-1, 1, 0], [gap, -1, 1], [gap, 1, 1]]
    box = cases.mesh("thing", vertices, [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]], bsdf=cases.diffuse(0.0))
    sensor = camera((0, 0, -4), (0, 0, 0), kind=kind)
    scene = cases.scene(sensor=sensor, thing=box, sky={"type": "constant"})
    motion = Motion(scene, "thing.vertex_positions", direction=[1, 0, 0], vertices=[1, 2, 4, 5])
    image = np.array(derivative_image(scene, mi.load_dict({"type": "direct_edge"}), motion, spp=256, seed=0))
    # The contour turns the sky black. In perspective, it is the far edge, and those that lead to it.
    pixels_per_unit = 16 / 4 if kind == "orthographic" else 16 / 2 / np.tan(np.radians(22.5))
    area = 2 if kind == "orthographic" else 1 / 5**2 + 1 / 4**2
    assert image[..., 0].sum() == pytest.approx(-area * pixels_per_unit**2, rel=0.01)


# ---------------------- Acute corners ----------------------


@pytest.mark.parametrize("faces", [2, 5])
def test_acute_corner_seen_from_inside(faces):
    """Two boards at 72°, one of which throws its shadow on the other, down to their common edge; or five in a star. So
    close to the edge, rays that leave one face start beyond the other."""
    angle = 0.3 + 2 * np.pi / 5 * np.arange(5)
    corners = np.concatenate([[[0, 0, -1], [0, 0, 1]], np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)])
    turned = corners @ np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0].T
    star = [[0, 1, 6], [1, 0, 2]] if faces == 2 else [[0, 1, 2 + k] for k in range(5)]
    board = cases.mesh("board", turned, star, bsdf=cases.diffuse(0.7, two_sided=True))
    lamp = {"type": "point", "position": [3, 1.3, 1], "intensity": 30.0}
    sensor = camera((0.37, 0.23, 4), (0.03, 0, 0))
    scene = cases.scene(sensor=sensor, board=board, lamp=lamp)
    integrator, path = mi.load_dict({"type": "direct_edge"}), mi.load_dict({"type": "path", "max_depth": 2})
    motion, step = Motion(scene, "board.vertex_positions", direction=(1, 0.3, 0)), 0.02
    ours = np.mean([np.array(derivative_image(scene, integrator, motion, spp=512, seed=i)) for i in range(4)], 0)
    images = []
    for θ in (step, -step):
        motion.apply(mi.Float(θ))
        images.append(np.mean([np.array(mi.render(scene, integrator=path, spp=2048, seed=i)) for i in range(4)], 0))
    expected = (images[0] - images[1]) / (2 * step)
    assert np.abs(ours - expected).sum() < 0.12 * np.abs(expected).sum()


# ---------------------- Faces that look to different sides ----------------------


@pytest.mark.parametrize("angle", [0, 30])
@pytest.mark.parametrize("divided", [False, True])
def test_back_of_a_face_beside_the_front_of_another(angle, divided):
    """Of a lamp of two faces, one shows its dark back: where their common edge moves, the bright area grows by half of
    its length times the way."""
    z = float(np.sin(np.radians(angle)))
    vertices = [[0, -1, 0], [0, 1, 0], [-1, 0, 0], [1, 0, z], [0, 0, 0]]
    faces = [[0, 1, 2], [0, 4, 3], [4, 1, 3]] if divided else [[0, 1, 2], [0, 1, 3]]
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    board = cases.mesh("board", vertices, faces, emitter=lamp, bsdf=cases.diffuse(0.0))
    sensor = cases.camera((0.2, 0.1, 5), (0.2, 0.1, 0), kind="orthographic")
    scene = cases.scene(sensor=sensor, board=board)
    vertices = (0, 1, 4) if divided else (0, 1)
    motion = Motion(scene, "board.vertex_positions", direction=(1, 0, 0), vertices=vertices)
    integrator = mi.load_dict({"type": "direct_edge"})
    seen = np.array(mi.render(scene, integrator=integrator, spp=1024, seed=9))[..., 0].sum()
    found = [np.array(derivative_image(scene, integrator, motion, spp=256, seed=i))[..., 0].sum() for i in range(8)]
    # The bright face is a triangle of width 1: its area grows by its own size for each unit.
    error = np.std(found, ddof=1) / np.sqrt(len(found))
    assert abs(np.mean(found) - seen) < 4 * error + 0.01 * seen and error < 0.02 * seen


@pytest.mark.parametrize("thickness", [0.1, 0.01, 0.001])
def test_sharp_edges_of_one_sided_surfaces(thickness):
    """Close to them, rays meet both faces at the same distance, up to rounding: they must not see the one that faces
    away, and is black."""
    vertices = cases.cube_vertices() @ np.diag([1, 1, thickness]) + [0, 0.6, 0]
    images = []
    for two_sided in (False, True):
        slab = cases.mesh("thing", vertices, cases.CUBE_FACES, bsdf=cases.diffuse(0.7, two_sided=two_sided))
        scene = cases.scene(sensor=camera((0.4, 1, -5)), thing=slab, sky={"type": "constant"})
        motion = Motion(scene, "thing.vertex_positions", direction=[1, 0.2, 0.4])
        made = mi.load_dict({"type": "direct_edge"})
        images.append(np.array(derivative_image(scene, made, motion, spp=64, seed=0), float))
    assert np.abs(images[0] - images[1]).sum() < 0.02 * np.abs(images[1]).sum()


def test_opacity_that_jumps_along_edges_of_a_smooth_ball(monkeypatch):
    """Where nothing shines behind, a hole is black paint, which counts once. (Paint would be held, and have other
    noise.)"""
    monkeypatch.setattr("rimlight.integrators._search.fine_textures", lambda *_: [])
    vertices, _, uv, faces = ball(8)
    squares = np.indices((4, 4)).sum(0)[..., None] % 2
    texels = {"type": "bitmap", "bitmap": mi.Bitmap(np.float32(squares)), "raw": True, "filter_type": "nearest"}
    paint = {"type": "diffuse", "reflectance": texels}
    mask = {"type": "mask", "opacity": texels, "nested": {"type": "diffuse", "reflectance": 1.0}}
    images = []
    for bsdf in (mask, paint):
        thing = cases.mesh("thing", 0.8 * vertices, faces, True, uv, bsdf=bsdf)
        lamp = cases.horizontal((0.6, 3, -0.8), 0.6, "lamp", down=True, emitter=cases.light(10, 10, 9))
        scene = cases.scene(sensor=camera((0.4, 1, -5), (0, 0, 0)), thing=thing, lamp=lamp)
        motion = Motion(scene, "thing.vertex_positions", direction=[1, 0.2, 0.4])
        made = mi.load_dict({"type": "direct_edge"})
        images.append(np.array(derivative_image(scene, made, motion, spp=256, seed=0), float))
    assert np.abs(images[0] - images[1]).sum() < 0.01 * np.abs(images[1]).sum()
