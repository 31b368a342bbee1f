"""Plugin `distant_lights`: what it reads, how it samples, that it agrees with Mitsuba's lights, and its derivatives."""

from __future__ import annotations

import inspect
import re
import textwrap

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight.edge_sampling.lights import Lights

#: Two discs that overlap, one apart, a light of radius 0, and a background.
MIXED = {
    "type": "distant_lights",
    "directions": "0.2 1 0.3, 0.1 1 0.5, -0.4 1 1.5, -.3 .5 .6",
    "irradiance": "1 1 1, 2 1 .5, 1 2 3, 1 1 1",
    "angular_radius": "20 10 30 0",
    "background": {"type": "rgb", "value": [0.3, 0.2, 0.4]},
}


def lights(directions, irradiance=None, **more) -> dict:
    given = {} if irradiance is None else {"irradiance": mi.TensorXf(np.array(irradiance))}
    return {"type": "distant_lights", "directions": mi.TensorXf(np.array(directions)), **given, **more}


def random_lights(count: int, seed: int = 0, grey: bool = False, **more) -> dict:
    """From the upper half (y > 0), of very different irradiance."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(count, 3))
    d[:, 1] = np.abs(d[:, 1])
    irradiance = np.exp(2 * rng.normal(size=(count, 1 if grey else 3))) * np.ones(3)
    return lights(d / np.linalg.norm(d, axis=1, keepdims=True), irradiance, **more)


def directional(emitter: dict) -> dict[str, dict]:
    """The same as lights of Mitsuba."""
    pairs = zip(np.array(emitter["directions"]), np.array(emitter["irradiance"]), strict=True)
    return {
        f"light{i}": {
            "type": "directional",
            "direction": (-d).tolist(),
            "irradiance": {"type": "rgb", "value": e.tolist()},
        }
        for i, (d, e) in enumerate(pairs)
    }


def plane(bsdf: dict | None = None, **emitters: dict) -> mi.Scene:
    """A wide floor, y = 0, that fills a frame of 8 × 8 pixels."""
    return cases.scene(
        sensor=cases.camera(film=cases.film(width=8, height=8), fov=20),
        floor=cases.horizontal((0, 0, 0), 30, "floor", bsdf=bsdf or cases.diffuse(0.5)),
        **emitters,
    )


def means(scene: mi.Scene, integrator: dict, spp: int, seeds: int = 6) -> np.ndarray:
    """Mean radiance of images: (seeds, 3)."""
    integrator = mi.load_dict(integrator)
    return np.stack(
        [np.array(mi.render(scene, integrator=integrator, spp=spp, seed=i)).mean((0, 1)) for i in range(seeds)]
    )


def z_score(a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference of two means over their first axes, in standard errors."""
    error = np.hypot(a.std(0, ddof=1) / len(a) ** 0.5, b.std(0, ddof=1) / len(b) ** 0.5)
    return float(np.max(np.abs(a.mean(0) - b.mean(0)) / error))


def samples(count: int, seed: int = 0) -> mi.Point2f:
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    return sampler.next_2d()


# ---------------------- What it reads ----------------------


@pytest.mark.parametrize("form", ["string", "tensor", "vectors", "txt", "csv", "npy", "xml"])
def test_forms_of_input(form, tmp_path):
    d, e, r = np.array([[0, 0, 1], [0.6, 0, -0.8]]), np.array([[1, 2, 3], [0.5, 0, 4]]), [3, 0.5]
    text = lambda a, sep: "\n".join(sep.join(map(str, row)) for row in a)
    radius = {"angular_radius": "3 0.5"}
    if form == "string":
        emitter = {"directions": "0 0 1, 0.6 0 -0.8", "irradiance": "1 2 3; 0.5 0 4,", **radius}
    elif form == "tensor":
        emitter = {"directions": mi.TensorXf(d), "irradiance": mi.TensorXf(e), "angular_radius": mi.TensorXf(r)}
    elif form == "vectors":
        emitter = {"directions": mi.Vector3f(d.T), "irradiance": mi.Color3f(e.T), **radius}
    elif form in ("txt", "csv"):
        for name, a in (("d", d), ("e", e)):
            (tmp_path / name).write_text("# x y z\n\n" + text(a, " " if form == "txt" else ", ") + "\n")
        emitter = {"directions_file": str(tmp_path / "d"), "irradiance_file": str(tmp_path / "e"), **radius}
    elif form == "npy":
        np.save(tmp_path / "d.npy", d)
        np.save(tmp_path / "e.npy", e)
        emitter = {"directions_file": str(tmp_path / "d.npy"), "irradiance_file": str(tmp_path / "e.npy"), **radius}
    if form == "xml":
        emitter = mi.load_string(
            '<emitter version="3.0.0" type="distant_lights"><string name="directions" value="0 0 1, 0.6 0 -0.8"/>'
            '<string name="irradiance" value="1 2 3, 0.5 0 4"/><string name="angular_radius" value="3 0.5"/></emitter>'
        )
    else:
        emitter = mi.load_dict({"type": "distant_lights", **emitter})
    assert emitter.light_count == 2
    assert np.array(emitter.directions) == pytest.approx(d, abs=1e-6)
    assert np.array(emitter.irradiance) == pytest.approx(e)
    assert np.array(emitter.angular_radius) == pytest.approx(r)


def test_one_value_for_all():
    emitter = mi.load_dict({"type": "distant_lights", "directions": "0 0 2, 0 3 0", "irradiance": 2.0})
    assert np.array(emitter.directions).tolist() == [[0, 0, 1], [0, 1, 0]]
    assert np.array(emitter.irradiance).tolist() == [[2, 2, 2], [2, 2, 2]]
    rgb = {"type": "rgb", "value": [1, 2, 3]}
    emitter = mi.load_dict({"type": "distant_lights", "directions": [0, 0, 2], "irradiance": rgb})
    assert np.array(emitter.irradiance).tolist() == [[1, 2, 3]]


def test_diligent(shared):
    folder = shared("diligent/ballPNG")
    files = {
        "directions_file": str(folder / "light_directions.txt"),
        "irradiance_file": str(folder / "light_intensities.txt"),
    }
    emitter = mi.load_dict({"type": "distant_lights", **files})
    assert emitter.light_count == 96
    assert np.array(emitter.directions)[0] == pytest.approx([-0.0635, -0.4317, 0.8998], abs=1e-4)
    assert np.array(emitter.irradiance)[0] == pytest.approx([1.2909, 1.5776, 2.1336])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"directions": None}, 'give "directions"'),
        ({"directions": "0 0 1, 0 0 0"}, "direction of light 2 is zero"),
        ({"directions": "0 0 1, 0 1"}, "row 2: 2 numbers, but 3 in those before"),
        ({"directions": "0 1"}, "must have 3 number"),
        ({"directions": ""}, "at least one row"),
        ({"directions": "0 0 one"}, 'expected numbers, got "0 0 one"'),
        ({"directions": "0 0 1, nan 0 1"}, "row 2 is not finite"),
        ({"directions": {"type": "rgb", "value": [0, 0, 0]}}, "direction of light 1 is zero"),
        ({"directions": {"type": "diffuse"}}, "must be numbers"),
        ({"directions_file": "nowhere.txt"}, 'either "directions" or "directions_file"'),
        ({"directions": None, "directions_file": "nowhere.txt"}, "there is no file"),
        ({"irradiance": "1 1 1, 1 1 1, 1 1 1"}, "has 3 rows for 2 lights"),
        ({"irradiance": "1 1 1, 1 -1 1"}, "must be >= 0.*for light 2"),
        ({"irradiance": "1 1 inf"}, "row 1 is not finite"),
        ({"angular_radius": -1.0}, "from 0 to below 90 degrees"),
        ({"angular_radius": 90.0}, "from 0 to below 90 degrees"),
        ({"angular_radius": "1 2 3"}, "has 3 rows for 2 lights"),
        ({"iradiance": 1.0}, "iradiance"),
    ],
)
def test_errors(wrong, message):
    emitter = {"type": "distant_lights", "directions": "0 0 1, 0 1 0", **wrong}
    with pytest.raises(Exception, match=message):
        mi.load_dict({k: v for k, v in emitter.items() if v is not None})


def test_errors_name_the_line_of_a_file(tmp_path):
    (tmp_path / "d.txt").write_text("0 0 1\n\n0 one 1\n")
    with pytest.raises(Exception, match=r'd\.txt, line 3: expected numbers, got "0 one 1"'):
        mi.load_dict({"type": "distant_lights", "directions_file": str(tmp_path / "d.txt")})


def test_parameters():
    def flags(emitter):
        params = mi.traverse(emitter)
        return {key: params.flags(key) for key, _ in params.items()}

    both = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
    found = flags(mi.load_dict(MIXED))
    assert found["directions"] == found["angular_radius"] == both
    assert found["irradiance"] == found["background.value"] == mi.ParamFlags.Differentiable
    assert "angular_radius" not in flags(mi.load_dict(random_lights(2)))  # hard shadows stay hard
    params = mi.traverse(mi.load_dict(MIXED))
    params["directions"] = mi.TensorXf(np.ones((2, 3)))
    with pytest.raises(ValueError, match="must keep its shape"):
        params.update()


@pytest.mark.parametrize("language", ["xml", "python"])
def test_example_of_the_manual(language):
    page = inspect.getdoc(type(mi.load_dict(MIXED)))
    code = re.search(rf"code-tab:: {language}\n\n((?: {{8}}.*\n?|\n)+)", page)[1]
    code = textwrap.dedent(code).strip()
    if language == "xml":
        emitter = mi.load_string(code.replace("<emitter ", '<emitter version="3.0.0" ', 1))
    else:
        emitter = mi.load_dict(eval(f"{{{code}}}"))
    assert emitter.light_count == 3


# ---------------------- Sampling ----------------------


def flat_samples(count: int) -> mi.Point2f:
    """Of `x` at both ends of [0, 1) and in the middle, `count` of each."""
    x = np.repeat([0, 0.5, 1 - 2**-24], count).astype(np.float32)
    return mi.Point2f(mi.Float(x), mi.Float(0.25))


@pytest.mark.parametrize("background", [False, True])
@pytest.mark.parametrize("radius", [0.0, 1.0])
def test_every_light_can_be_chosen(background, radius):
    K = 1000
    emitter = mi.load_dict(random_lights(K, angular_radius=radius, **({"background": 0.2} if background else {})))
    which = dr.tile(dr.arange(mi.UInt32, K), 3)
    sample, probability = emitter.light_sample(which, flat_samples(K))
    it = dr.zeros(mi.Interaction3f, 3 * K)
    ds, weight = emitter.sample_direction(it, sample)
    assert dr.all(emitter.of_light(ds))
    assert np.array_equal(np.array(ds.uv.x), np.array(which) + 1)
    away = np.linalg.norm(np.array(ds.d).T - np.array(emitter.directions)[np.array(which)], axis=1)
    assert away.max() <= 2 * np.sin(np.radians(radius) / 2) + 1e-6
    expected = np.array(emitter.irradiance)[np.array(which)] / np.cos(np.radians(radius) / 2) ** 2
    found = np.array(weight * probability).T
    assert found == pytest.approx(expected, rel=1e-4)
    total = float(dr.sum(probability)[0]) / 3
    assert 0.05 < total < 0.95 if background else total == pytest.approx(1, abs=1e-5)


def test_probabilities_are_those_of_uniform_numbers():
    K, N = 20, 1 << 18
    emitter = mi.load_dict(random_lights(K, background=0.5))
    ds, _ = emitter.sample_direction(dr.zeros(mi.Interaction3f, N), samples(N))
    counts = np.bincount(np.array(ds.uv.x).astype(int), minlength=K + 1)
    p = np.array(emitter.light_sample(dr.arange(mi.UInt32, K), mi.Point2f(0.5))[1])
    p = np.concatenate([[1 - p.sum()], p])
    assert np.abs((counts - N * p) / np.sqrt(N * p * (1 - p))).max() < 4.5


def test_lights_one_by_one():
    """Each light by itself; together they are all."""
    scene = plane(lights=MIXED, other={"type": "point", "position": [0, 5, 0]})
    found, N = Lights(scene), 1 << 16
    assert len(found) == 5
    it = dr.zeros(mi.Interaction3f, N)
    emitter = next(e for e in scene.emitters() if hasattr(e, "light_count"))
    first = next(i for i in range(5) if scene.emitters()[found.emitter[i]] is emitter or i == 5)
    for k in range(4):
        ds, weight = found.sample_direction(scene, mi.UInt32(first + k), it, samples(N), mi.Bool(True))
        # The mean of weight · cos over a disc is irradiance: no noise but that of cos.
        axis = mi.Vector3f(np.array(emitter.directions)[k])
        mean = np.array(dr.mean(weight * dr.dot(ds.d, axis), axis=1)).ravel()
        assert mean == pytest.approx(np.array(emitter.irradiance)[k], rel=2e-3)


@pytest.mark.parametrize(
    "emitter",
    [
        {"directions": "0.3 -0.5 0.8", "angular_radius": 40.0},
        {"directions": "0 0 1, 1 0 0, 0.6 0 0.8", "irradiance": "1 1 1, 3 3 3, 2 2 2", "angular_radius": "30 50 35"},
        {"directions": "0 1 1, 0 0 -1", "angular_radius": "25 60", "background": 0.4},
    ],
)
def test_chi2(emitter):
    from mitsuba.chi2 import ChiSquareTest, EmitterAdapter, SphericalDomain

    sample, pdf = EmitterAdapter("distant_lights", {"type": "distant_lights", **emitter})
    test = ChiSquareTest(SphericalDomain(), sample, pdf, sample_dim=2, sample_count=400_000, res=101, ires=16)
    assert test.run(quiet=True)


def test_density_of_samples():
    """The density that a sample comes with is that of its direction; lights of radius 0 come with a probability."""
    N = 1 << 14
    emitter = mi.load_dict(MIXED)
    it = dr.zeros(mi.SurfaceInteraction3f, N)
    ds, _ = emitter.sample_direction(it, samples(N))
    delta, pdf = np.array(ds.delta), np.array(emitter.pdf_direction(it, ds))
    at_border = ~np.isclose(np.array(ds.pdf), pdf, rtol=1e-4)
    assert at_border[~delta].mean() < 1e-3
    p = emitter.light_sample(mi.UInt32(3), mi.Point2f(0))[1]
    assert 0 < delta.mean() < 1
    assert np.array(ds.pdf)[delta] == pytest.approx(float(p[0]))


# ---------------------- Mitsuba's lights ----------------------


@pytest.mark.parametrize(
    "other_variant", ["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_spectral_polarized"]
)
def test_agrees_with_directional(other_variant):
    """Also in its shadows. Grey in spectral variants, where the spectra of colours differ."""
    mi.set_variant(other_variant)
    try:
        emitter = random_lights(5, grey="spectral" in other_variant)
        more = {"cube": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0.4, 0]).scale(0.3)}}
        images = []
        pixels = "luminance" if "mono" in other_variant else "rgb"
        for given in ({"lights": emitter}, directional(emitter)):
            scene = cases.scene(
                sensor=cases.camera(film=cases.film(width=8, height=8, pixel_format=pixels), fov=20),
                floor=cases.horizontal((0, 0, 0), 30, "floor", bsdf=cases.diffuse(0.5)),
                **more,
                **given,
            )
            images.append(means(scene, {"type": "path", "max_depth": 3}, 256))
    finally:
        mi.set_variant("llvm_ad_rgb")
    assert z_score(*images) < 4


def test_colours_in_spectral_variants():
    """They are those of rgb, and grey is D65 exactly, as Mitsuba has it."""
    colours = [[1, 1, 1], [1, 0, 0], [0.2, 0.7, 0.4], [0.1, 0.1, 3]]
    mi.set_variant("llvm_ad_spectral")
    try:
        for colour in colours:
            light = lights([[0, 1, 0]], [colour])
            image = means(plane(lights=light), {"type": "path", "max_depth": 2}, 4096, seeds=1)[0]
            assert image == pytest.approx(0.5 / np.pi * np.array(colour), abs=0.02 * max(colour))
        grey = mi.load_dict(lights([[0, 1, 0]], [[2, 2, 2]]))
        it = dr.zeros(mi.SurfaceInteraction3f, 8)
        it.wavelengths = mi.Color0f(0) if mi.is_rgb else type(it.wavelengths)(mi.Float(np.linspace(400, 700, 8)))
        same = mi.load_dict({"type": "directional", "irradiance": {"type": "rgb", "value": [2, 2, 2]}})
        found = [np.array(e.sample_direction(it, mi.Point2f(0.5))[1]) for e in (grey, same)]
    finally:
        mi.set_variant("llvm_ad_rgb")
    assert found[0] == pytest.approx(found[1], rel=1e-4)


def test_irradiance_of_discs():
    """Of a disc above the horizon, a plane receives irradiance · cos: projected solid angle is π sin² a cos."""
    d, e = np.array([[0.3, 0.8, 0.2], [0.1, 0.9, -0.1]]), [[1, 2, 3], [3, 1, 2]]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    found = means(plane(lights=lights(d, e, angular_radius="25 40")), {"type": "path", "max_depth": 2}, 1024)
    expected = (0.5 / np.pi) * d[:, 1] @ np.array(e)
    error = found.std(0, ddof=1) / len(found) ** 0.5
    assert np.abs((found.mean(0) - expected) / error).max() < 4.5
    assert error.max() < 0.002


def test_soft_shadow_of_a_disc():
    """As that of a disc at a finite, great distance."""
    d, radius, far = np.array([0.3, 0.8, -0.4]), 5.0, 1e4
    d /= np.linalg.norm(d)
    radiance = 2 / (np.pi * np.sin(np.radians(radius)) ** 2)
    T = mi.ScalarTransform4f
    at = T().look_at((far * d).tolist(), [0, 0, 0], [0, 0, 1]).scale(float(far * np.tan(np.radians(radius))))
    there = {"type": "disk", "to_world": at, "emitter": cases.light(radiance, radiance, radiance)}
    images = []
    for light in (lights([d], [[2, 2, 2]], angular_radius=radius), there):
        scene = cases.scene(
            sensor=cases.camera(film=cases.film(width=16, height=16), fov=40),
            floor=cases.horizontal((0, 0, 0), 5, "floor", bsdf=cases.diffuse(0.5)),
            blocker=cases.horizontal((0.2, 1, 0), 0.4, "blocker", bsdf=cases.diffuse(0.5)),
            light=light,
        )
        integrator = mi.load_dict({"type": "path", "max_depth": 2})
        images.append(np.stack([np.array(mi.render(scene, integrator=integrator, spp=64, seed=i)) for i in range(8)]))
    a, b = (i.mean(0) for i in images)
    error = np.sqrt((images[0].var(0, ddof=1) + images[1].var(0, ddof=1)) / 8)
    assert np.abs(a - b).mean() < 1.2 * error.mean()
    assert np.abs(a.mean() - b.mean()) < 0.003 * b.mean()
    assert 0.02 < (b / b.max() < 0.5).mean() < 0.5  # there is a shadow


def test_background_agrees_with_constant():
    lit = {"type": "distant_lights", "directions": "0 1 0", "irradiance": 0.0, "background": MIXED["background"]}
    a = means(plane(lights=lit), {"type": "path", "max_depth": 2}, 256)
    b = means(plane(sky={"type": "constant", "radiance": MIXED["background"]}), {"type": "path", "max_depth": 2}, 256)
    assert z_score(a, b) < 4.5


# ---------------------- Rimlight's integrators ----------------------

BSDFS = {
    "diffuse": lambda: cases.diffuse(0.5),
    "glossy": lambda: cases.conductor(0.3),
    "plastic": lambda: {"type": "plastic"},
    "mirror": lambda: {"type": "conductor"},
}


@pytest.mark.parametrize("bsdf", BSDFS)
def test_integrators_agree(bsdf):
    scene = plane(BSDFS[bsdf](), lights=MIXED)
    a = means(scene, {"type": "path", "max_depth": 2}, 256)
    b = means(scene, {"type": "direct_edge"}, 256)
    assert z_score(a, b) < 4.5 if bsdf != "mirror" else np.allclose(a, b)


def numbers(scene: mi.Scene, key: str, integrator: dict, spp: int, seeds: int) -> tuple[np.ndarray, np.ndarray]:
    """Derivative of the mean radiance along a direction in the space of a parameter, forward and backward."""
    params = mi.traverse(scene)
    initial = type(params[key])(params[key])
    direction = np.random.default_rng(1).normal(size=initial.shape).astype(np.float32)
    integrator, forward, backward = mi.load_dict(integrator), [], []
    for seed in range(seeds):
        θ = mi.Float(0)
        dr.enable_grad(θ)
        params[key] = initial + θ * type(initial)(direction)
        params.update()
        dr.forward(θ, dr.ADFlag.ClearEdges)
        image = integrator.render_forward(scene, params, spp=spp, seed=seed)
        forward.append(np.array(image).mean((0, 1)))

        value = type(initial)(initial)
        dr.enable_grad(value)
        params[key] = value
        params.update()
        weights = np.zeros(image.shape, np.float32)
        weights[:] = [1, 0, 0]
        integrator.render_backward(scene, params, mi.TensorXf(weights / weights[..., 0].size), spp=spp, seed=seed)
        backward.append(float(np.sum(np.array(dr.grad(value)) * direction)))
    params[key] = initial
    params.update()
    return np.array(forward), np.array(backward)


def differences(scene: mi.Scene, key: str, max_depth: int, step: float, spp: int, seeds: int) -> np.ndarray:
    params = mi.traverse(scene)
    initial = type(params[key])(params[key])
    direction = type(initial)(np.random.default_rng(1).normal(size=initial.shape).astype(np.float32))
    found = []
    for h in (step, -step):
        params[key] = initial + h * direction
        params.update()
        found.append(means(scene, {"type": "path", "max_depth": max_depth}, spp, seeds))
    params[key] = initial
    params.update()
    return (found[0] - found[1]) / (2 * step)


STEPS = {"directions": 0.02, "irradiance": 0.2, "angular_radius": 0.5, "background.value": 0.1}


@pytest.mark.parametrize("bsdf", ["diffuse", "glossy"])
@pytest.mark.parametrize("key", STEPS)
def test_derivatives_of_images(bsdf, key):
    """Of a plane that nothing occludes: light samples must follow the discs, which overlap."""
    scene = plane(BSDFS[bsdf](), lights=MIXED)
    reference = differences(scene, f"lights.{key}", 2, STEPS[key], 1024, 6)
    for integrator in ({"type": "direct_edge", "sppi": 0}, {"type": "prb_edge", "max_depth": 3, "sppi": 0}):
        forward, backward = numbers(scene, f"lights.{key}", integrator, 256, 6)
        assert z_score(forward, reference) < 4.5
        assert backward == pytest.approx(forward[:, 0], rel=1e-3, abs=1e-5)
    if key != "angular_radius" or bsdf == "glossy":  # on a diffuse plane, irradiance does not know the radius
        assert np.abs(forward.mean(0)).min() > 10 * np.abs(forward.std(0)).max() / 6**0.5


def test_derivatives_of_delta_lights_are_exact():
    """Of irradiance · cos on a diffuse plane."""
    d, e = np.array([[0.3, 0.8, 0.2], [0.1, 0.9, -0.1]]), np.array([[1.0, 2, 3], [3, 1, 2]])
    scene = plane(lights=lights(d, e))
    forward, _ = numbers(scene, "lights.directions", {"type": "direct_edge", "sppi": 0}, 1024, 6)
    n = d / np.linalg.norm(d, axis=1, keepdims=True)
    v = np.random.default_rng(1).normal(size=d.shape)
    dcos = (v - n * (v * n).sum(1, keepdims=True))[:, 1]
    error = forward.std(0, ddof=1) / 6**0.5
    assert np.abs((forward.mean(0) - 0.5 / np.pi * dcos @ e) / error).max() < 4.5
    assert np.abs(0.5 / np.pi * dcos @ e).min() > 20 * error.max()


# ---------------------- Derivatives of the plugin ----------------------


def at_fixed_samples(emitter: mi.Emitter, what: str) -> mi.Float:
    """A random linear combination of what it returns, so that it depends on everything."""
    N = 1 << 12
    it = dr.zeros(mi.SurfaceInteraction3f, N)
    if what == "eval":
        it.wi = -mi.warp.square_to_uniform_sphere(samples(N))
        value = emitter.eval(it)
    elif what == "eval_direction":
        with dr.suspend_grad():
            ds, _ = emitter.sample_direction(it, samples(N))
        value = emitter.eval_direction(it, ds) / ds.pdf
    else:
        ds, weight = emitter.sample_direction(it, samples(N))
        value = {"direction": ds.d, "weight": weight}[what]
    w = np.random.default_rng(2).normal(size=(3, N)).astype(np.float32)
    return sum(dr.sum(dr.mean(mi.Float(a) * c)) for a, c in zip(w, value, strict=True)) * N**0.5


@pytest.mark.parametrize(
    ("what", "key", "depends"),
    [
        ("direction", "directions", True),
        ("direction", "angular_radius", True),
        ("weight", "angular_radius", True),
        ("weight", "irradiance", True),
        ("weight", "background.value", True),
        ("eval", "irradiance", True),
        ("eval", "background.value", True),
        ("eval_direction", "irradiance", True),
        ("eval_direction", "background.value", True),
        ("weight", "directions", False),
        ("direction", "irradiance", False),
    ],
)
def test_derivatives_at_fixed_samples(what, key, depends, monkeypatch):
    emitter = mi.load_dict(MIXED)
    monkeypatch.setattr(type(emitter), "parameters_changed", lambda self, keys=(): None)  # keep the choice of lights
    params = mi.traverse(emitter)
    initial = type(params[key])(params[key])
    direction = np.random.default_rng(1).normal(size=initial.shape).astype(np.float32)

    def put(θ):
        params[key] = initial + θ * type(initial)(direction)
        params.update()

    h, found = 0.5 if key == "angular_radius" else 0.02, []
    for step in (h, -h):
        put(step)
        found.append(float(at_fixed_samples(emitter, what)[0]))
    reference = (found[0] - found[1]) / (2 * h)

    θ = mi.Float(0)
    dr.enable_grad(θ)
    put(θ)
    dr.forward(θ, dr.ADFlag.ClearEdges)
    forward = dr.forward_to(at_fixed_samples(emitter, what), flags=dr.ADFlag.AllowNoGrad)
    value = type(initial)(initial)
    dr.enable_grad(value)
    params[key] = value
    params.update()
    dr.backward(at_fixed_samples(emitter, what), dr.ADFlag.AllowNoGrad)
    backward = np.sum(np.array(dr.grad(value)) * direction)

    assert float(forward[0]) == pytest.approx(reference, rel=5e-3, abs=2e-4)
    assert backward == pytest.approx(float(forward[0]), rel=1e-3, abs=1e-4)
    assert (abs(reference) > 2e-3) == depends


def test_black_lights_have_derivatives():
    emitter = mi.load_dict(lights([[0, 1, 0], [0, 0, 1]], [[1, 1, 1], [0, 0, 0]]))
    params = mi.traverse(emitter)
    dr.enable_grad(params["irradiance"])
    params.update()
    N = 1 << 14
    _, weight = emitter.sample_direction(dr.zeros(mi.Interaction3f, N), samples(N))
    dr.backward(dr.sum(dr.mean(weight, axis=1)))
    assert np.array(params["irradiance"].grad) == pytest.approx(np.ones((2, 3)), rel=0.1)


# ---------------------- Freezing ----------------------


@pytest.mark.parametrize("integrator", ["path", "direct_edge"])
def test_freezing(integrator):
    """A frozen function sees new parameters. (Nothing can be frozen in spectral variants.)"""
    scene = plane(lights=MIXED)
    integrator = mi.load_dict({"type": integrator})
    params = mi.traverse(scene)
    irradiance, directions = params["lights.irradiance"], params["lights.directions"]

    def render(scene, integrator, seed):
        return mi.render(scene, integrator=integrator, spp=16, seed=seed)

    frozen = dr.freeze(render)
    for i in range(4):
        params["lights.irradiance"] = irradiance * dr.opaque(mi.Float, 1 + i)
        params["lights.directions"] = directions + dr.opaque(mi.Float, 0.1 * i)
        params.update()
        seed = dr.opaque(mi.UInt32, i)
        image = np.array(render(scene, integrator, seed))
        assert np.array(frozen(scene, integrator, seed)) == pytest.approx(image, rel=1e-4)
    assert frozen.n_recordings == 1
