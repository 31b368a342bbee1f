"""`bdpt`: agreement with `path` for every sort of light, surface, sensor and filter; weights, ways, refusals."""

from __future__ import annotations

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import rooms

from rimlight import scenes
from rimlight._image_advice import ImageAdvice, image_advice
from rimlight.checks import mean_and_error, z_scores
from rimlight.cli import main
from rimlight.integrators._light_image import LightImage
from rimlight.transport.found_light import Seen
from rimlight.transport.subpath_weights import Shorter, weight

RUNS = 16


def small(rfilter: str = "box", **options) -> dict:
    return cases.film(rfilter, **{"width": 16, "height": 16, **options})


def eye(kind: str = "perspective", origin=rooms.LOOK[0], target=rooms.LOOK[1], **options) -> dict:
    return cases.camera(origin, target, kind, **{"film": small(), **options})


def ball(bsdf: dict, name: str = "ball") -> dict:
    return {name: {"type": "sphere", "center": [0.1, 0.4, 0.1], "radius": 0.4, "bsdf": bsdf}}


def room(**objects) -> mi.Scene:
    """A room in which a ball lies under a lamp. objects : besides, or instead of what is there."""
    lamp = {} if any(name.startswith("lamp") for name in objects) else {"lamp": rooms.lamp()}
    defaults = {"sensor": eye(), **rooms.walls(), **ball(cases.diffuse(0.6, 0.5, 0.3)), **lamp}
    return cases.scene(**defaults | objects)


def images(scene: mi.Scene, kind: str, spp: int, first: int, **options) -> np.ndarray:
    it = mi.load_dict({"type": kind, "max_depth": 5, **options})
    return np.array([mi.render(scene, integrator=it, spp=spp, seed=first + i) for i in range(RUNS)], np.float64)


def assert_equal(found: np.ndarray, expected: np.ndarray) -> None:
    """Images that differ by noise alone."""
    assert np.isfinite(found).all()
    if not expected.any():
        assert not found.any()
        return
    z = z_scores(*mean_and_error(found), *mean_and_error(expected))
    totals = [mean_and_error(i.mean((1, 2))) for i in (found, expected)]
    error = np.sqrt(totals[0][1] ** 2 + totals[1][1] ** 2)
    assert (np.abs(totals[0][0] - totals[1][0]) <= 4 * error + 1e-6).all()
    assert np.mean(z**2) < 1.3
    assert np.abs(z).max() < 7


def assert_equals_path(scene: mi.Scene, spp: int = 64, kind: str = "path", **options) -> None:
    path_options = {k: v for k, v in options.items() if k not in ("light_paths", "spp_per_pass")}
    assert_equal(images(scene, "bdpt", spp, 0, **options), images(scene, kind, spp, 1000, **path_options))


# ---------------------- Weights ----------------------


@pytest.mark.parametrize("count", [3, 4, 6, 9])
def test_weights_of_all_ways_sum_to_one(variant, count):
    """Of random paths, against the densities of all ways themselves.

    A path has the vertices x_0 on the light, ..., x_{count - 1} at the camera. `onwards[i]` is the density with which a
    light subpath finds x_i from the vertices before; `back[i]`, with which a camera path does; both by area.
    """
    rng, n = np.random.default_rng(count), 64
    distance = rng.uniform(0.5, 2, (count - 1, n))  # between x_i and x_{i + 1}
    towards, away = rng.uniform(0.1, 1, (2, count, n))  # cosines at x_i, to x_{i - 1} and to x_{i + 1}
    pdf, reverse = np.exp(rng.normal(0, 1.5, (2, count, n)))  # at x_i, of x_{i + 1} and of x_{i - 1}
    mirror = rng.uniform(size=(count, n)) < 0.3
    mirror[[0, -1]] = False
    pdf, reverse = np.where(mirror, 1, pdf), np.where(mirror, 1, reverse)
    first, last = np.exp(rng.normal(size=(2, n)))  # of x_0, when it is sampled by area; of x_0 by light samples
    onwards = [first, *(pdf[i] * towards[i + 1] / distance[i] ** 2 for i in range(count - 1))]
    back = [reverse[i + 1] * away[i] / distance[i] ** 2 for i in range(count - 1)]

    density = []  # of the way with s vertices from the light; 0: by no connection
    for s in range(count):
        p = np.ones(n)
        for i in range(count - 1):
            found = last if s == 1 and i == 0 else onwards[i] if i < s else back[i]
            p = p * found
        connected = ~mirror[s - 1] & ~mirror[s] if s else True
        density.append(np.where(connected, p, 0))
    expected = np.array(density) ** 2 / np.sum(np.square(density), 0)

    f = lambda x: mi.Float(np.broadcast_to(x, n).astype(np.float32))
    light = Shorter(f(last / (first * pdf[0])), f(away[0] / (first * pdf[0])))
    from_light = {}
    for i in range(1, count - 1):
        light = from_light[i] = light.at(f(distance[i - 1]), f(towards[i]))
        light = light.beyond(f(away[i]), f(pdf[i]), f(reverse[i]), mi.Bool(mirror[i]))
    camera = Shorter(dr.rcp(f(reverse[-1])), f(0))
    from_camera = {}
    for i in range(count - 2, 0, -1):
        camera = from_camera[i] = camera.at(f(distance[i]), f(away[i]))
        camera = camera.beyond(f(towards[i]), f(reverse[i]), f(pdf[i]), mi.Bool(mirror[i]))
    # Light samples and what rays meet, in densities by solid angle, at x_0.
    to_angle = f(distance[0] ** 2 / away[0])
    found = [weight(f(last) * to_angle * camera.one, f(first * pdf[0] / away[0]) * camera.more)]
    x1 = from_camera[1]
    arrival = f(first * pdf[0] / distance[0] ** 2)  # at x_1, by area across the ray
    found.append(
        weight(
            f(back[0] / last),
            arrival * f(towards[1]) / f(last) * x1.shorter(f(pdf[1])),
        )
    )
    for s in range(2, count - 1):
        y, z = from_light[s - 1], from_camera[s]
        found.append(weight(f(back[s - 1]) * y.shorter(f(reverse[s - 1])), f(onwards[s]) * z.shorter(f(pdf[s]))))
    found.append(weight(f(back[count - 2]) * from_light[count - 2].shorter(f(reverse[count - 2]))))
    found = np.where(np.array(density) > 0, np.array([np.array(w) for w in found]), 0)
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-6)
    np.testing.assert_allclose(found.sum(0), 1, rtol=1e-4)


def test_the_ways_add_up_to_the_image(variant):
    scene = room(**ball({"type": "roughdielectric", "alpha": 0.3}))
    it = mi.load_dict({"type": "bdpt", "max_depth": 4})
    image = np.array(mi.render(scene, integrator=it, spp=8, seed=3))
    parts = {}
    for k in range(2, 6):
        for s in range(k):
            it.ways = (s, k - s)
            parts[it.ways] = np.array(mi.render(scene, integrator=it, spp=8, seed=3))
    np.testing.assert_allclose(sum(parts.values()), image, rtol=1e-3, atol=1e-4 * image.max())
    # One segment has one way, that of the camera.
    assert not parts[1, 1].any()
    assert all(part.any() for way, part in parts.items() if way != (1, 1))


# ---------------------- Images ----------------------

PICTURE = np.stack(np.broadcast_arrays(*np.ogrid[0:1:16j, 0:1:16j], 0.5), -1).astype(np.float32) * 4
DOWN = [0.1, 1.7, -0.2], [0.1, 0.3, 0.2], [0, 0, 1]


def picture() -> dict:
    return {"type": "bitmap", "bitmap": mi.Bitmap(PICTURE), "raw": True, "wrap_mode": "clamp"}


def surroundings() -> dict:
    rows, columns = np.ogrid[0 : np.pi : 32j, 0 : 2 * np.pi : 64j]
    shining = 0.3 + 4 * np.exp(-8 * ((rows - 1) ** 2 + (columns - 2) ** 2))
    bitmap = mi.Bitmap(np.repeat(shining[..., None], 3, 2).astype(np.float32))
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f().rotate([0.8, 0.6, 0], 50)}


def ceiling_lamp(shape: str, **emitter) -> dict:
    to_world = mi.ScalarTransform4f().translate([0.1, 1.9, -0.2]).rotate([1, 0, 0], 90).scale(0.3)
    return {"type": shape, "to_world": to_world, "emitter": {"type": "area", **emitter}}


def down() -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().look_at(*DOWN)


def lights() -> dict[str, dict]:
    return {
        "mesh": rooms.lamp(),
        "disk": ceiling_lamp("disk", radiance=9.0),
        "sphere": {"type": "sphere", "center": DOWN[0], "radius": 0.2, "emitter": cases.light(9, 8, 7)},
        "cylinder": {"type": "cylinder", "p0": [-0.5, 1.2, 0.2], "radius": 0.1, "emitter": cases.light(9, 8, 7)}
        | {"p1": [-0.2, 1.3, 0.2]},
        "texture": ceiling_lamp("rectangle", radiance=picture()),
        "point": {"type": "point", "position": DOWN[0], "intensity": 3.0},
        "spot": {"type": "spot", "to_world": down(), "intensity": 9.0, "cutoff_angle": 30.0},
        "projector": {"type": "projector", "to_world": down(), "irradiance": picture(), "fov": 40.0},
        "led": {"type": "led", "position": DOWN[0], "axis": [0, -1, 0.2], "intensity": 3.0, "mu": 1.5},
        "directional": {"type": "directional", "direction": [0.2, -1, 0.3], "irradiance": 3.0},
        "constant": cases.constant(),
        "envmap": surroundings(),
        "sunsky": {"type": "sunsky", "sun_scale": 0.02, "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90)},
        "distant_lights": {"type": "distant_lights", "directions": "-0.2 1 -0.3, 0.3 1 -0.2", "background": 0.3}
        | {"angular_radius": "0, 8"},
    }


LIGHTS = "mesh disk sphere cylinder texture point spot projector led directional constant envmap sunsky distant_lights"


@pytest.mark.parametrize("light", LIGHTS.split())
def test_lights(variant, light):
    assert_equals_path(room(lamp=lights()[light]))


def test_several_lights_with_weights(variant):
    point = {**lights()["point"], "sampling_weight": 3.0}
    silent = {**lights()["spot"], "sampling_weight": 0.0}
    assert_equals_path(room(lamp=point, lamp_at_ceiling=rooms.lamp(), sky=cases.constant(0.2), lamp_unsampled=silent))


SURFACES = {
    "mirror": {"type": "conductor"},
    "metal": {"type": "roughconductor", "alpha": 0.15},
    "glass": {"type": "dielectric"},
    "rough glass": {"type": "roughdielectric", "alpha": 0.2},
    "thin glass": {"type": "thindielectric"},
    "mask": {"type": "mask", "opacity": 0.5, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}},
    "plastic": {"type": "plastic"},
    "rough plastic": {"type": "roughplastic", "alpha": 0.2},
    "principled": {"type": "principled", "roughness": 0.3, "spec_trans": 0.4, "clearcoat": 0.5, "sheen": 0.3},
    "blend": {"type": "blendbsdf", "weight": 0.4, "a": {"type": "diffuse"}, "b": {"type": "roughconductor"}},
    "blinn_phong": {"type": "blinn_phong"},
}


def bumpy(bsdf: dict, depth: float) -> dict:
    tilt = np.random.default_rng(1).uniform(0.5 - depth, 0.5 + depth, (16, 16, 3)).astype(np.float32)
    tilt[..., 2] = 1
    return {"type": "normalmap", "bsdf": bsdf, "normalmap": {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(tilt)}}


@pytest.mark.parametrize("surface", SURFACES)
def test_surfaces(variant, surface):
    assert_equals_path(room(**ball(SURFACES[surface])))


@pytest.mark.parametrize(("surface", "depth"), [("metal", 0.2), ("glass", 0.1)])
def test_normal_maps(variant, surface, depth):
    assert_equals_path(room(**ball(bumpy(SURFACES[surface], depth))))


def test_interpolated_normals(variant):
    """Of a coarse ball, whose shading normals are far from those of its faces."""
    p, _, _, faces = cases.ball(4)
    mesh = cases.mesh("ball", np.asarray(p) * 0.4 + [0.1, 0.4, 0.1], faces, normals=True, bsdf=SURFACES["rough glass"])
    assert_equals_path(room(ball=mesh))


def test_instances(variant):
    p, _, _, faces = cases.ball(4)
    group = {"type": "shapegroup", "ball": cases.mesh("ball", p, faces, bsdf=SURFACES["metal"])}
    to_world = mi.ScalarTransform4f().translate([0.1, 0.4, 0.1]).scale([0.5, 0.4, 0.3])
    ball = {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": to_world}
    assert_equals_path(room(group=group, ball=ball))


CAUSTICS = [("point", "mirror"), ("spot", "thin glass"), ("directional", "glass"), ("led", "mask")]


@pytest.mark.parametrize(("light", "surface"), CAUSTICS)
def test_caustics_of_lights_without_size(variant, light, surface):
    """`path` lacks them. `ptracer` has them on surfaces that are matt themselves."""
    floor = cases.camera((0.8, 1.0, -0.9), (0.55, 0, -0.35), film=small(), fov=28)
    scene = room(sensor=floor, lamp=lights()[light], **ball(SURFACES[surface]))
    assert_equals_path(scene, spp=256, kind="ptracer")


def test_beams(variant):
    """`directionalarea`, which `path` does not see."""
    beam = ceiling_lamp("rectangle", type="directionalarea", radiance=4.0)
    assert_equals_path(room(sensor=eye(origin=(0.8, 1.0, -0.9), target=(0.55, 0, -0.35)), lamp=beam), kind="ptracer")


SENSORS = {
    "thinlens": lambda: eye("thinlens", aperture_radius=0.1, focus_distance=3.0),
    "orthographic": lambda: eye("orthographic"),
    "fisheye": lambda: eye("fisheye", (0.2, 1, -0.6), (0, 0.6, 0.3), fov=150.0),
    "principal point": lambda: eye(principal_point_offset_x=0.2, principal_point_offset_y=-0.1),
    "clipping": lambda: eye(near_clip=3.2, far_clip=4.4),
    "crop window": lambda: eye(
        film=small(width=32, height=24, crop_width=16, crop_height=10, crop_offset_x=5, crop_offset_y=7)
    ),
    "batch": lambda: {
        "type": "batch",
        "film": small(width=32),
        "left": eye(),
        "right": eye(origin=(0.5, 1.2, -2.5)),
    },
    "radiancemeter": lambda: {
        "type": "radiancemeter",
        "film": small(width=1, height=1),
        "origin": [0.8, 1.0, -0.9],
        "direction": [-0.25, -1, 0.55],
    },
}


@pytest.mark.parametrize("sensor", SENSORS)
def test_sensors(variant, sensor):
    assert_equals_path(room(sensor=SENSORS[sensor]()), spp=256 if sensor == "radiancemeter" else 64)


@pytest.mark.parametrize("rfilter", ["gaussian", "tent", "mitchell", "lanczos"])
@pytest.mark.parametrize("border", [False, True])
def test_filters(variant, rfilter, border):
    assert_equals_path(room(sensor=eye(film=small(rfilter, sample_border=border))))


@pytest.mark.parametrize("rfilter", ["box", "gaussian", "mitchell"])
@pytest.mark.parametrize("border", [False, True])
def test_light_is_normalised_whatever_the_camera_samples(variant, rfilter, border):
    """A constant image stays one, though the film divides by weights that vary from pixel to pixel."""
    film = mi.load_dict(small(rfilter, sample_border=border, pixel_format="rgba"))
    film.prepare([])
    light, camera = LightImage(film, 2), film.create_block()
    border = film.rfilter().border_size() if border else 0
    lower, upper = -border, 16 + border
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 2 * (upper - lower) ** 2)
    pixel = dr.arange(mi.UInt32, 2 * (upper - lower) ** 2) // 2
    corner = mi.Point2f(mi.Float(pixel % (upper - lower)), mi.Float(pixel // (upper - lower))) + lower
    camera.put(corner + sampler.next_2d(), [mi.Float(0)] * 3 + [mi.Float(1), mi.Float(1)])
    n = 8 * (upper - lower)
    grid = mi.Point2f(dr.meshgrid(dr.arange(mi.Float, n), dr.arange(mi.Float, n)))
    seen = Seen((grid + 0.5) / 8 + lower, mi.Point2f(0), mi.UInt32(1))
    light.add((), seen, mi.Spectrum(2 / 64), None, mi.Bool(True))
    light.add_to(camera)
    image = np.array(film.develop())
    np.testing.assert_allclose(image[..., :3], 1, rtol=1e-2)
    np.testing.assert_allclose(image[..., 3], 1, rtol=1e-5)


OPTIONS = [
    {"max_depth": 0},
    {"max_depth": 1},
    {"max_depth": 2},
    {"max_depth": 3},
    {"max_depth": -1, "rr_depth": 1},
    {"max_depth": 5, "hide_emitters": True},
    {"max_depth": 4, "light_paths": 3},
    {"max_depth": 4, "spp_per_pass": 16},
]


@pytest.mark.parametrize("options", OPTIONS, ids=lambda o: " ".join(f"{k} {v}" for k, v in o.items()))
def test_options(variant, options):
    """Colours and alpha. The sensor looks past the lamp into the open."""
    sensor = eye(film=small(pixel_format="rgba"), fov=70.0)
    objects = ball(SURFACES["glass"])
    scene = room(sensor=sensor, lamp_below={"type": "sphere", "center": [0.5, 0.2, -0.6], "radius": 0.2}
                 | {"emitter": cases.light(2, 2, 2)}, lamp=rooms.lamp(), **objects)  # fmt: skip
    assert_equals_path(scene, **options)


def test_monochrome(variant):
    mi.set_variant("llvm_ad_mono")
    try:
        assert_equals_path(room())
    finally:
        mi.set_variant(variant)


def test_empty_scenes_are_black(variant):
    it = mi.load_dict({"type": "bdpt"})
    assert not np.array(mi.render(cases.scene(sensor=eye()), integrator=it, spp=1)).any()
    assert not np.array(mi.render(cases.scene(sensor=eye(), **rooms.walls()), integrator=it, spp=1)).any()


# ---------------------- Refusals ----------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"maxdepth": 3}, 'unknown property "maxdepth", did you mean "max_depth"'),
        ({"max_depth": -2}, '"max_depth" must be a whole number >= 0, or -1'),
        ({"rr_depth": 0}, '"rr_depth" must be a whole number >= 1'),
        ({"light_paths": 0.0}, '"light_paths" must be a number above 0'),
        ({"light_paths": True}, '"light_paths" must be a number above 0'),
        ({"spp_per_pass": 0}, '"spp_per_pass" must be a whole number >= 1'),
    ],
    ids=lambda x: "" if isinstance(x, str) else next(iter(x)),
)
def test_wrong_options_are_refused(variant, options, message):
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "bdpt", **options})


def test_passes_must_divide_the_samples(variant):
    with pytest.raises(RuntimeError, match='"spp_per_pass", 3, must divide the 4 samples'):
        mi.load_dict({"type": "bdpt", "spp_per_pass": 3}).render(room(), spp=4)


def test_media_are_refused(variant):
    fog = {"type": "cube", "interior": {"type": "homogeneous"}, "bsdf": {"type": "null"}}
    with pytest.raises(RuntimeError, match="participating media are not supported: remove them, or use"):
        mi.load_dict({"type": "bdpt"}).render(room(fog=fog), spp=1)


def test_derivatives_are_refused(variant):
    scene = room()
    params = mi.traverse(scene)
    it = mi.load_dict({"type": "bdpt"})
    with pytest.raises(RuntimeError, match="has no derivative, use bdpt_edge"):
        it.render_forward(scene, params)
    with pytest.raises(RuntimeError, match="has no derivative, use bdpt_edge"):
        it.render_backward(scene, params, mi.TensorXf(0))


def test_spectral_variants_are_refused(variant):
    mi.set_variant("llvm_ad_spectral")
    try:
        with pytest.raises(RuntimeError, match=r"spectral variants are not supported.*set an rgb or mono variant"):
            mi.load_dict({"type": "bdpt"})
    finally:
        mi.set_variant(variant)


# ---------------------- Scenes of the test suite ----------------------


#: Of these, `path` sees next to nothing in as many samples. `ptracer` does: what the camera sees is matt.
RARE = ("lampshade", "lampshade_wall", "out_of_frame")

#: Of these, `path` lacks what comes from a light without size through a veil, as `ptracer` does not.
VEILED = ("veil_turns", "leaf_turns")

#: Of these, `path` lacks what their mirror throws of lights without size.
CAUSTICS = ("shadow_in_mirror", "shadow_in_mirror_turns", "shadow_in_mirror_light", "shadows_of_ball")


@pytest.mark.parametrize(
    "case", [c for c in cases.CASES if c.needs is None and c.name not in CAUSTICS], ids=lambda c: c.name
)
def test_scenes_of_derivatives(variant, case):
    scene = (case.reference_scene or case.scene)()
    kind = "ptracer" if case.name in (*RARE, *VEILED) else "path"
    assert_equals_path(scene, spp=16, kind=kind, max_depth=max(case.max_depth, 3))


@pytest.mark.parametrize("name", scenes.names())
def test_shipped_scenes(variant, name):
    scene = mi.load_file(str(scenes.path(name)), res=16)
    kind = "ptracer" if name in RARE else "path"
    assert_equals_path(scene, spp=256 if name in RARE else 64, kind=kind, max_depth=scene.integrator().depths.max_depth)


# ---------------------- Where it pays ----------------------


@pytest.mark.parametrize(
    ("name", "expected", "derivative"),
    [
        ("glossy_caustic", "bdpt", "bdpt_edge"),
        ("door_ajar", "bdpt", "bdpt_edge"),
        ("lampshade", "bdpt", "bdpt_edge"),
        ("lit_room", "path", "prb_edge"),
        ("cube", "path", "direct_edge"),
        ("shadow_blocker", "path", "direct_edge"),
    ],
)
def test_advice(variant, name, expected, derivative):
    scene = mi.load_file(str(scenes.path(name)), res=32)
    advice = image_advice(scene, max_depth=8)
    assert advice.integrator == expected and advice.derivative == derivative
    assert str(advice).startswith(f"images: {expected}") and f"derivatives: {derivative}" in str(advice)
    assert (advice.share > 0.05) == (expected == "bdpt")


def test_advice_on_what_is_not_supported(variant):
    fog = {"type": "cube", "interior": {"type": "homogeneous"}, "bsdf": {"type": "null"}}
    with pytest.raises(RuntimeError, match="participating media are not supported"):
        image_advice(room(fog=fog))


def test_plan_gives_advice(variant, capsys):
    arguments = ["plan", str(scenes.path("shadow_blocker")), "--integrator", "direct_edge", "-D", "res=16"]
    assert main([*arguments, "--images"]) == 0
    with_advice = capsys.readouterr().out
    assert main(arguments) == 0
    assert with_advice == capsys.readouterr().out + f"{ImageAdvice('path', 0.0, 0.0)}\n"
