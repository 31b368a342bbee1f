"""Reference derivatives: central differences of Mitsuba's `path`, with what they are uncertain about."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm

from rimlight._collection import no_collection
from rimlight.edge_sampling.projection.sensors import sampled_border
from rimlight.edge_sampling.refusals import InputError
from rimlight.exr import read_exr, write_exr

from .motion import Motion

#: Samples per pixel that are added up in single precision.
PASS = 256


@dataclass(frozen=True)
class FiniteDifferences:
    """A derivative image, and what is known of its errors.

    mean : (H, W, C), float32, linear radiance per unit of θ; central differences with half the step.
    standard_error : (H, W, C), float32; of the mean, from the spread of the runs.
    step_error : (H, W, C), float32; by how much the whole step gives another result. It bounds the error of the half
        step where an edge enters or leaves a pixel within it (the error grows at least linearly with the step), and
        exceeds it where the image is smooth.
    settings : how it was made.
    """

    mean: np.ndarray
    standard_error: np.ndarray
    step_error: np.ndarray
    settings: dict[str, Any]

    def write(self, path: str | Path, metadata: dict[str, Any] | None = None) -> None:
        """Write an EXR file: mean in R, G, B, the errors in layers of their names, settings in the header."""
        write_exr(
            path,
            {"": self.mean, "standard_error": self.standard_error, "step_error": self.step_error},
            {**self.settings, **(metadata or {})},
        )

    @staticmethod
    def read(path: str | Path) -> FiniteDifferences:
        """Read what `write` wrote; the settings come back as text."""
        layers, metadata = read_exr(path)
        return FiniteDifferences(layers[""], layers["standard_error"], layers["step_error"], metadata)


def finite_differences(
    scene: mi.Scene,
    motion: Motion,
    *,
    step: float,
    runs: int = 32,
    spp: int = 4096,
    max_depth: int = 2,
    integrator: mi.Integrator | None = None,
    sensor: int | mi.Sensor = 0,
    seed: int = 0,
    side: Literal[-1, 0, 1] = 0,
    progress: bool = False,
) -> FiniteDifferences:
    """Central differences (I(+h) − I(−h)) / 2h over independent runs, for a step and for half of it.

    The four images of a run share their random numbers, drawn from a stratified sampler (`multijitter`): at hard edges
    this is 3 to 7 times less noise than independent samples. Choose h so that the image moves by a few hundredths of a
    pixel: a tenth already smears hard edges visibly.

    Parameters
    ----------
    step : h, in units of θ.
    runs : number of independent runs, at least 2; their spread gives the standard error.
    spp : samples per pixel of each image, a square number is best.
    max_depth : of `path`, unless another `integrator` is given.
    sensor : its number in the scene, or itself, also one that is not part of the scene.
    side : 1 or -1 stands for differences to that side alone, (I(+h) − I(0)) / h or (I(0) − I(−h)) / h. If both differ
        however small h is, the image has no derivative: two surfaces begin to part, say. Then central differences are
        the mean of both.

    Raises
    ------
    ValueError : `step`, `runs` or `spp` out of range.
    """
    if not (np.isfinite(step) and step > 0):
        raise InputError(f"finite differences: the step must be > 0, got {step}")
    if runs < 2 or spp < 1:
        raise InputError(f"finite differences: need at least 2 runs and 1 sample per pixel, got {runs} and {spp}")
    integrator = integrator or mi.load_dict({"type": "path", "max_depth": max_depth})
    spp = mi.load_dict({"type": "multijitter", "sample_count": spp}).sample_count()  # rounded once, not for each image
    camera = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
    differences = []
    try:
        for i in tqdm(range(runs), desc="finite differences", disable=not progress):
            run = []
            for h in (step, step / 2):
                ends, images = (min(side + 1, 1) * h, max(side - 1, -1) * h), []
                for theta in ends:
                    motion.apply(theta)
                    images.append(render_stratified(scene, integrator, camera, seed + i, spp))
                run.append((images[0] - images[1]) / (ends[0] - ends[1]))
            differences.append(run)
    finally:
        motion.restore()
    whole, half = np.mean(differences, axis=0)
    standard_error = np.std([d[1] for d in differences], axis=0, ddof=1) / np.sqrt(runs)
    settings = {
        "motion": str(motion),
        "unit": motion.unit,
        "step": step,
        "side": side,
        "runs": runs,
        "spp": spp,
        "seed": seed,
        "integrator": " ".join(str(integrator).split()),
        "mitsuba": mi.__version__,
        "variant": mi.variant(),
    }
    mean, error, step_error = (a.astype(np.float32) for a in (half, standard_error, np.abs(whole - half)))
    return FiniteDifferences(mean, error, step_error, settings)


@no_collection()
def render_stratified(scene: mi.Scene, integrator: mi.Integrator, sensor: mi.Sensor, seed: int, spp: int) -> np.ndarray:
    """Render with the `multijitter` sampler, whichever the sensor has: (H, W, C), linear radiance, double precision.

    integrator : a sampling integrator of Mitsuba (`path`, `direct`, `aov`, ...). Of one with channels besides light
        (`aov_names`), these alone are returned, without an image of light. `bdpt`, whose paths do not all start at the
        camera, takes the sensor's own sampler.
    """
    from mitsuba.python.ad.integrators.common import ADIntegrator

    if type(integrator).__name__ == "BDPTIntegrator":
        passes = next(n for n in range(-(-spp // PASS), spp + 1) if spp % n == 0)
        images = [
            np.array(integrator.render(scene, sensor, seed * passes + i, spp // passes), np.float64)
            for i in range(passes)
        ]
        return np.mean(images, axis=0)
    film = sensor.film()
    sampler = mi.load_dict({"type": "multijitter", "sample_count": spp})
    spp = sampler.sample_count()
    # Sums of many more equal numbers are not exact enough in single precision: a difference of images shows it.
    passes = next(n for n in range(-(-spp // PASS), spp + 1) if spp % n == 0)
    border = 2 * sampled_border(film)
    sampler.set_samples_per_wavefront(spp // passes)
    sampler.seed(seed, int(np.prod(np.array(film.crop_size()) + border)) * (spp // passes))
    images, names = [], integrator.aov_names()
    with dr.suspend_grad():
        for _ in range(passes):
            film.prepare(names)
            ray, weight, position = ADIntegrator.sample_rays(None, scene, sensor, _Pass(sampler, spp // passes))
            L, valid, channels = integrator.sample(scene, sampler, ray)
            block = film.create_block()
            alpha = dr.select(valid, mi.Float(1), 0)
            ADIntegrator._splat_to_block(block, film, position, L * weight, 1.0, alpha, channels, ray.wavelengths)
            film.put_block(block)
            images.append(np.array(film.develop(), np.float64)[:, :, -len(names) :])
            sampler.schedule_state()
            sampler.advance()
    return np.mean(images, axis=0)


@dataclass(frozen=True)
class _Pass:
    """A sampler, but for the number of samples that one of its passes has."""

    sampler: mi.Sampler
    count: int

    def sample_count(self) -> int:
        return self.count

    def __getattr__(self, name: str) -> Any:
        return getattr(self.sampler, name)
