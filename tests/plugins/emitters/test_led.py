"""Plugin `led` and tables of LEDs: against Mitsuba's `point`, analytic irradiance and finite differences."""

from __future__ import annotations

import inspect
import re
import textwrap

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight import leds

LED = {
    "type": "led",
    "position": [0.3, 1.5, -0.2],
    "axis": [-0.4, -2.0, 0.3],
    "mu": 1.7,
    "intensity": {"type": "rgb", "value": [3, 2, 4]},
}


def plane(bsdf: dict | None = None, size: int = 8, pixel_format: str = "rgb", **emitters: dict) -> mi.Scene:
    """A wide floor, y = 0, that fills the frame."""
    film = cases.film(width=size, height=size, pixel_format=pixel_format)
    return cases.scene(
        sensor=cases.camera(film=film, fov=20),
        floor=cases.horizontal((0, 0, 0), 30, "floor", bsdf=bsdf or cases.diffuse(0.5)),
        **emitters,
    )


def render(scene: mi.Scene, integrator: dict, spp: int = 64, seed: int = 0) -> np.ndarray:
    return np.array(mi.render(scene, integrator=mi.load_dict(integrator), spp=spp, seed=seed))


PATH = {"type": "path", "max_depth": 2}


# ---------------------- The plugin ----------------------


@pytest.mark.parametrize(
    "other_variant", ["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_spectral_polarized"]
)
def test_isotropic_light_is_a_point(other_variant):
    """At mu = 0, also backwards."""
    mi.set_variant(other_variant)
    try:
        pixels = "luminance" if "mono" in other_variant else "rgb"
        common = {key: LED[key] for key in ("position", "intensity")}
        images = [
            render(plane(pixel_format=pixels, light={**light, **common}), PATH)
            for light in ({"type": "led", "mu": 0.0, "axis": [0, 1, 0]}, {"type": "point"})
        ]
    finally:
        mi.set_variant("llvm_ad_rgb")
    assert images[0] == pytest.approx(images[1], rel=1e-4)
    assert images[1].mean() > 0.01


def test_irradiance_of_a_plane():
    """I₀ cos^μ θ cos θ_x / r², where the sample is."""
    emitter = mi.load_dict(LED)
    x = np.random.default_rng(0).normal(size=(3, 100)) * [[2], [0], [2]]
    it = dr.zeros(mi.Interaction3f, 100)
    it.p = mi.Point3f(x.astype(np.float32))
    ds, weight = emitter.sample_direction(it, mi.Point2f(0.5))
    to_light = np.array(LED["position"])[:, None] - x
    r = np.linalg.norm(to_light, axis=0)
    axis = np.array(LED["axis"]) / np.linalg.norm(LED["axis"])
    cos = np.maximum(-(axis @ to_light) / r, 0)
    expected = np.array([[3], [2], [4]]) * cos**1.7 / r**2
    assert np.array(weight) == pytest.approx(expected, rel=1e-4, abs=1e-7)
    assert np.array(ds.d) == pytest.approx(to_light / r, abs=1e-6)
    assert np.array(ds.dist) == pytest.approx(r, rel=1e-6)
    assert np.array(emitter.eval_direction(it, ds)) == pytest.approx(expected, rel=1e-4, abs=1e-7)
    assert dr.all(ds.delta)


def test_nothing_behind():
    light = {**LED, "axis": [0, 1, 0]}
    assert render(plane(light=light), PATH).max() == 0


@pytest.mark.parametrize("mu", [0.0, 0.5, 1.0, 4.0])
def test_rays_from_the_light(mu):
    """Their density is that of the intensity: they carry the same to the plane as samples of the light."""
    emitter = mi.load_dict({**LED, "mu": mu})
    N = 1 << 18
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, N)
    ray, weight = emitter.sample_ray(mi.Float(0), mi.Float(0), sampler.next_2d(), sampler.next_2d())
    mean = lambda a: np.array(dr.mean(a, axis=1)).ravel()
    t = -ray.o.y / ray.d.y
    hit, edge = ray(t), 0.5
    inside = (t > 0) & (dr.abs(hit.x) < edge) & (dr.abs(hit.z) < edge)
    flux = mean(dr.select(inside, weight, 0))

    it = dr.zeros(mi.Interaction3f, N)
    uv = sampler.next_2d()
    it.p = mi.Point3f((2 * uv.x - 1) * edge, 0, (2 * uv.y - 1) * edge)
    ds, irradiance = emitter.sample_direction(it, mi.Point2f(0.5))
    assert flux == pytest.approx(mean(irradiance * ds.d.y) * (2 * edge) ** 2, rel=0.02)


def test_particle_tracing():
    scene = plane(light=LED)
    integrator = {"type": "ptracer", "max_depth": 2, "hide_emitters": True}
    assert render(scene, integrator, 4096).mean() == pytest.approx(render(scene, PATH, 256).mean(), rel=0.1)


@pytest.mark.parametrize("integrator", [{"type": "direct_edge"}, {"type": "prb_edge", "max_depth": 2}])
def test_integrators_agree(integrator):
    scene = plane(light=LED)
    assert render(scene, integrator, 1024) == pytest.approx(render(scene, PATH, 1024), rel=0.02)


def test_to_world():
    T = mi.ScalarTransform4f().translate([1, 2, 3]).rotate([1, 0, 0], 90).scale(2)
    emitter = mi.load_dict({"type": "led", "to_world": T})
    assert np.array(emitter.position).ravel() == pytest.approx([1, 2, 3])
    assert np.array(dr.normalize(emitter.axis)).ravel() == pytest.approx([0, -1, 0], abs=1e-6)


def test_parameters():
    params = mi.traverse(mi.load_dict(LED))
    flags = {key: params.flags(key) for key, _ in params.items()}
    smooth = mi.ParamFlags.Differentiable
    assert flags == {
        "position": smooth | mi.ParamFlags.Discontinuous,
        "axis": smooth,
        "intensity.value": smooth,
        "mu": smooth,
    }


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"axis": [0, 0, 0]}, '"axis" must not be zero'),
        ({"mu": -0.5}, '"mu" must be a number >= 0, got -0.5'),
        ({"mu": float("nan")}, '"mu" must be a number >= 0'),
        ({"mu": "one"}, '"mu" must be a number >= 0, got one'),
        ({"position": [0, float("inf"), 0]}, '"position" must be finite'),
        ({"position": "somewhere"}, '"position" must be three numbers'),
        ({"to_world": None}, 'either "to_world"'),
        ({"nu": 1.0}, "nu"),
    ],
)
def test_errors(wrong, message):
    if "to_world" in wrong:
        wrong = {"to_world": mi.ScalarTransform4f()}
    with pytest.raises(Exception, match=message):
        mi.load_dict({**LED, **wrong})


@pytest.mark.parametrize("language", ["xml", "python"])
def test_example_of_the_manual(language):
    page = inspect.getdoc(type(mi.load_dict(LED)))
    code = re.search(rf"code-tab:: {language}\n\n((?: {{8}}.*\n?|\n)+)", page)[1]
    code = textwrap.dedent(code).strip()
    if language == "xml":
        emitter = mi.load_string(code.replace("<emitter ", '<emitter version="3.0.0" ', 1))
    else:
        emitter = mi.load_dict(eval(f"{{{code}}}"))
    assert float(emitter.mu[0]) == 1.5
    assert np.array(emitter.position).ravel() == pytest.approx([0.2, 0.1, 0.5])


# ---------------------- Derivatives ----------------------

#: Directions in the space of each parameter, and steps of finite differences.
MOTIONS = {
    "position": ([0.5, 0.3, -0.7], 0.01),
    "axis": ([0.6, 0.2, 0.5], 0.02),
    "intensity.value": ([1, -0.5, 0.3], 0.1),
    "mu": ([1], 0.02),
}


@pytest.mark.parametrize("bsdf", ["diffuse", "glossy"])
@pytest.mark.parametrize("key", MOTIONS)
@pytest.mark.parametrize("integrator", [{"type": "direct_edge", "sppi": 0}, {"type": "prb_edge", "sppi": 0}])
def test_derivatives_of_images(integrator, key, bsdf):
    """Pixel by pixel: at the same random numbers, finite differences have no noise."""
    scene = plane(cases.diffuse(0.5) if bsdf == "diffuse" else cases.conductor(0.3), light=LED)
    params, key = mi.traverse(scene), f"light.{key}"
    direction, h = MOTIONS[key.removeprefix("light.")]
    initial = type(params[key])(params[key])
    direction = type(initial)(direction)
    spp, seed = 256, 3
    integrator = mi.load_dict(integrator)

    def put(θ):
        params[key] = initial + θ * direction
        params.update()

    images = []
    for step in (h, -h):
        put(step)
        images.append(np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed)))
    reference = (images[0] - images[1]) / (2 * h)

    θ = mi.Float(0)
    dr.enable_grad(θ)
    put(θ)
    dr.forward(θ, dr.ADFlag.ClearEdges)
    forward = np.array(integrator.render_forward(scene, params, spp=spp, seed=seed))

    value = type(initial)(initial)
    dr.enable_grad(value)
    params[key] = value
    params.update()
    w = np.random.default_rng(0).normal(size=forward.shape).astype(np.float32)
    integrator.render_backward(scene, params, mi.TensorXf(w), spp=spp, seed=seed)
    backward = np.sum(np.array(dr.grad(value)).ravel() * np.array(direction).ravel())

    assert np.abs(reference).max() > 1e-3
    assert np.abs(forward - reference).mean() < 0.01 * np.abs(reference).mean()
    assert backward == pytest.approx(np.sum(w * forward), rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("mu", [0.0, 0.5, 1.0, 2.0])
def test_derivatives_edge_on(mu):
    """In the plane of the light and behind it derivatives are numbers, and zero behind."""
    emitter = mi.load_dict({"type": "led", "position": [0, 0, 0], "axis": [0, 0, 1], "mu": mu})
    params = mi.traverse(emitter)
    for key in ("position", "axis", "mu"):
        dr.enable_grad(params[key])
    params.update()
    it = dr.zeros(mi.Interaction3f, 3)
    it.p = mi.Point3f([1, 1, 0], [0, 0, 0], [0, -1e-3, -2])
    _, weight = emitter.sample_direction(it, mi.Point2f(0.5))
    assert np.array(weight)[0] == pytest.approx([1, 1, 0.25] if mu == 0 else [0, 0, 0], rel=1e-4)
    dr.backward(dr.sum(weight.x))
    for key in ("axis", "mu"):
        assert np.array(dr.grad(params[key])).ravel() == pytest.approx(0, abs=0)
    assert np.isfinite(np.array(dr.grad(params["position"]))).all()


def test_freezing():
    scene = plane(light=LED)
    integrator = mi.load_dict({"type": "direct_edge"})
    params = mi.traverse(scene)
    initial = mi.Point3f(params["light.position"])

    def image(scene, integrator, seed):
        return mi.render(scene, integrator=integrator, spp=16, seed=seed)

    frozen = dr.freeze(image)
    for i in range(4):
        params["light.position"] = initial + dr.opaque(mi.Float, 0.2 * i)
        params["light.mu"] = dr.opaque(mi.Float, 1 + i)
        params.update()
        seed = dr.opaque(mi.UInt32, i)
        expected = np.array(image(scene, integrator, seed))
        assert np.array(frozen(scene, integrator, seed)) == pytest.approx(expected, rel=1e-4)
    assert frozen.n_recordings == 1


# ---------------------- Tables ----------------------

RIG = [
    leds.Led((0.1, 1 / 3, 2e-17), (0.0, -1.0, 0.1), 0.7, (1.0, 2.5, 1e9 / 7)),
    leds.Led((-4.0, 5.0, -6.0), (0.0, 0.0, 1.0), 0.0, (0.0, 0.0, 0.0)),
]


def test_round_trip_is_exact(tmp_path):
    leds.write_leds(tmp_path / "rig.csv", RIG)
    assert leds.read_leds(tmp_path / "rig.csv") == RIG
    assert (tmp_path / "rig.csv").read_text().splitlines()[0] == "x,y,z,ax,ay,az,mu,r,g,b"


def test_tables_of_others(tmp_path):
    """Columns in another order, spaces, empty lines, a byte order mark, the line ends of Windows."""
    path = tmp_path / "rig.csv"
    path.write_text("\ufeffmu, x,y,z, ax,ay,az, r,g,b\r\n\r\n1, 1,2,3, 0,0,-1, 4,5,6\r\n", encoding="utf-8")
    assert leds.read_leds(path) == [leds.Led((1, 2, 3), (0, 0, -1), 1, (4, 5, 6))]


def test_tables_are_scenes(tmp_path):
    leds.write_leds(tmp_path / "rig.csv", RIG)
    scene = mi.load_dict({"type": "scene", **leds.emitters(leds.read_leds(tmp_path / "rig.csv"))})
    assert len(scene.emitters()) == 2
    params = mi.traverse(scene)
    assert np.array(params["led0.position"]).ravel() == pytest.approx([0.1, 1 / 3, 0])
    assert np.array(params["led0.intensity.value"]).ravel() == pytest.approx([1, 2.5, 1e9 / 7])
    assert float(params["led1.mu"][0]) == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: the columns must be x,y,z.*missing x, y, z"),
        ("x,y,z,ax,ay,az,r,g,b\n", "line 1: .*missing mu"),
        ("x,y,z,ax,ay,az,mu,r,g,b,name\n", "line 1: .*unknown or twice name"),
        ("x,y,z,ax,ay,az,mu,r,g,b\n1,2,3,0,0,1,1,1,1,1\n1,2,3,0,0,1,one,1,1,1\n", 'line 3, column "mu": .*got "one"'),
        ("x,y,z,ax,ay,az,mu,r,g,b\n1,nan,3,0,0,1,1,1,1,1\n", 'line 2, column "y": expected a finite number, got nan'),
        ("x,y,z,ax,ay,az,mu,r,g,b\n1,2,3,0,0,1,1,1,-1,1\n", 'line 2, column "g": expected a number >= 0, got -1'),
        ("x,y,z,ax,ay,az,mu,r,g,b\n1,2,3,0,0,1,-1,1,1,1\n", 'line 2, column "mu": expected a number >= 0'),
        ("x,y,z,ax,ay,az,mu,r,g,b\n1,2,3,0,0,0,1,1,1,1\n", 'line 2, columns "ax", "ay", "az": the axis is zero'),
        ("x,y,z,ax,ay,az,mu,r,g,b\n1,2,3\n", 'line 2, column "ax": expected a number, got ""'),
        ("x,y,z,ax,ay,az,mu,r,g,b\n1,2,3,0,0,1,1,1,1,1,1\n", "line 2: 11 values for 10 columns"),
    ],
)
def test_errors_name_line_and_column(text, message, tmp_path):
    (tmp_path / "rig.csv").write_text(text)
    with pytest.raises(ValueError, match=rf"rig\.csv, {message}"):
        leds.read_leds(tmp_path / "rig.csv")
