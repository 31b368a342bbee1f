"""The commands: one frozen dataclass each, whose fields are its options."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import mitsuba as mi
import numpy as np
from tyro.conf import UseAppendAction, arg

import rimlight
from rimlight import pictures
from rimlight._image_advice import image_advice
from rimlight.checks import Agreement, FiniteDifferences, Motion, compare, derivative_image, two_sides
from rimlight.edge_sampling.geometry.meshes import is_positions_key
from rimlight.exr import write_exr
from rimlight.loading import InputError, load_integrator, use_variant

from . import _loading
from ._loading import at_least
from ._shared import OnMotion, OnScene, OnSensor, accumulate, progress, seeds, write_image, writing


@dataclass(frozen=True)
class SysInfo:
    """Print the versions, the hardware, and what works on this machine."""

    def run(self) -> int:
        from rimlight.sys_info import print_sys_info

        print_sys_info()
        return 0


@dataclass(frozen=True, kw_only=True)
class Params(OnScene):
    """List the parameters of a scene. ∂ marks those that can be differentiated, D those that also move edges."""

    def run(self) -> int:
        rows = [("parameter", "type", "size", "flags")]
        for key, value, flags in _loading.differentiable(self.load()):
            shape = np.shape(value) or (1,)
            rows.append((key, type(value).__name__, " x ".join(map(str, shape)), flags))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        for row in rows:
            print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
        return 0


@dataclass(frozen=True, kw_only=True)
class PlanCommand(OnSensor):
    """Print what a derivative needs: which terms, how many edges, how many rays; and what it will lack."""

    param: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="KEY")] = ()
    """Parameter that changes, as `rimlight params` lists it. May be repeated. Default: the camera and all vertices."""
    integrator: str | None = None
    """Integrator that renders: direct_edge, prb_edge or bdpt_edge. Default: the scene's own if it is one of these, or
    else prb_edge."""
    spp: int = 16
    """Samples per pixel."""
    images: bool = False
    """Say also which integrator suits images of the scene, and which its derivatives. With --param, the noise of these
    derivatives is measured. Takes some seconds for the image, and up to a minute for derivatives."""

    def run(self) -> int:
        at_least(1, spp=self.spp)
        scene = self.load()
        integrator = scene.integrator() if self.integrator is None else load_integrator(self.integrator)
        if not hasattr(integrator, "plan"):
            if self.integrator is not None:
                raise InputError(f'--integrator: "{self.integrator}" has no plan, use direct_edge or prb_edge')
            integrator = load_integrator("prb_edge")
        keys = list(self.param) or [
            key
            for key, _, _ in _loading.differentiable(scene)
            if is_positions_key(key) or key == _loading.camera_key(scene, self.sensor)
        ]
        print(rimlight.plan(scene, keys, integrator=integrator, sensor=self.sensor, spp=self.spp))
        if self.images:
            # Channels have no reflected light, images do.
            self._advise(scene, max(integrator.depths.max_depth, 2))
        return 0

    def _advise(self, scene: Any, longest: int) -> None:
        """Print which integrators suit. longest : path, in segments."""
        max_depth = longest if longest < 0xFFFFFFFF else -1
        seen = image_advice(scene, sensor=self.sensor, max_depth=max_depth)
        if not self.param:
            print(seen)
            return
        from rimlight.inverse.advice import advice  # only now, since it imports much

        print(seen.images)
        print(
            advice(
                scene,
                self.param,
                sensor=self.sensor,
                max_depth=max_depth,
                direct=seen.derivative == "direct_edge",
                seed=self.seed,
            )
        )


@dataclass(frozen=True, kw_only=True)
class Render(OnSensor):
    """Render a scene to an EXR and a PNG file."""

    out: Path
    """Folder for image.exr and image.png, or the name of the EXR file."""
    integrator: str = "direct_edge"
    """Integrator plugin that renders."""
    spp: int = 64
    """Samples per pixel."""

    def run(self) -> int:
        at_least(1, spp=self.spp)
        to_file = self.out.suffix == ".exr"
        _loading.check_output(self.out, folder=not to_file)
        scene = self.load()
        integrator = load_integrator(self.integrator)
        start = time.perf_counter()
        image = accumulate(
            lambda seed, spp: mi.render(scene, integrator=integrator, sensor=self.sensor, spp=spp, seed=seed),
            seeds(self.spp, self.pixels(scene), self.seed),
            "render",
        )
        metadata = self.metadata(
            integrator=self.integrator, spp=self.spp, seed=self.seed, seconds=f"{time.perf_counter() - start:.3f}"
        )
        folder = _loading.make_folder(self.out.parent if to_file else self.out)
        with writing():
            write_image(folder / (self.out.stem if to_file else "image"), image, metadata)
        return 0


@dataclass(frozen=True, kw_only=True)
class Gradient(OnMotion):
    """Render the derivative of an image with respect to a motion, and the image."""

    out: Path
    """Folder for image.exr, image.png, derivative.exr and derivative.png."""
    integrator: str = "direct_edge"
    """Integrator plugin that differentiates."""
    spp: int = 256
    """Samples per pixel."""

    def run(self) -> int:
        at_least(1, spp=self.spp)
        _loading.check_output(self.out, folder=True)
        scene = self.load()
        integrator = load_integrator(self.integrator)
        motion = self.load_motion(scene)
        launches = seeds(self.spp, self.pixels(scene), self.seed)

        start = time.perf_counter()
        derivative = accumulate(
            lambda seed, spp: derivative_image(scene, integrator, motion, sensor=self.sensor, spp=spp, seed=seed),
            launches,
            "derivative",
        )
        seconds = time.perf_counter() - start
        image = accumulate(
            lambda seed, spp: mi.render(scene, integrator=integrator, sensor=self.sensor, spp=spp, seed=seed),
            launches,
            "image",
        )

        what = str(motion)
        metadata = self.metadata(integrator=self.integrator, spp=self.spp, seed=self.seed, seconds=f"{seconds:.3f}")
        folder = _loading.make_folder(self.out)
        with writing():
            write_image(folder / "image", image, metadata)
            moved = {"key": motion.key, "motion": what, "unit": motion.unit}
            write_exr(folder / "derivative.exr", {"": derivative}, {**metadata, **moved})
            pictures.write_derivative(folder / "derivative.png", derivative, title=what, unit=motion.unit)
        return 0


@dataclass(frozen=True, kw_only=True)
class FiniteDifferencesCommand(OnMotion):
    """Render a reference derivative by central differences of Mitsuba's `path`."""

    out: Path
    """EXR file to write. Its layer `standard_error` holds the noise of each pixel."""
    step: float
    """Step h of (I(+h) - I(-h)) / 2h. Choose it such that the image moves by a few hundredths of a pixel."""
    runs: int = 32
    """Number of independent runs, at least 2."""
    spp: int = 4096
    """Samples per pixel of each image."""
    max_depth: int = 2
    """`max_depth` of `path`."""

    def run(self) -> int:
        if self.out.suffix != ".exr":
            raise InputError(f'--out: "{self.out}" must end in .exr')
        at_least(1, spp=self.spp, max_depth=self.max_depth)
        _loading.check_output(self.out, folder=False)
        scene = self.load()
        motion = self.load_motion(scene)
        start = time.perf_counter()
        reference = self.reference(
            scene, motion, step=self.step, runs=self.runs, spp=self.spp, max_depth=self.max_depth
        )
        seconds = f"{time.perf_counter() - start:.3f}"
        _loading.make_folder(self.out.parent)
        with writing():
            reference.write(self.out, self.metadata(motion=str(motion), key=motion.key, seconds=seconds))
        return 0


#: How far apart one-sided differences may be (`two_sides`) where an image has a derivative: edges enter and leave
#: pixels within a step.
BENDS = 0.25


@dataclass(frozen=True, kw_only=True)
class Check(OnMotion):
    """Compare a derivative with finite differences. The exit code is 1 if they disagree by more than their noise. Then,
    differences to each side alone tell whether the image has a derivative at all."""

    step: float
    """Step h of the finite differences. Choose it such that the image moves by a few hundredths of a pixel."""
    integrator: str = "direct_edge"
    """Integrator plugin that differentiates."""
    spp: int = 64
    """Samples per pixel of one derivative."""
    seeds: int = 16
    """Number of derivatives to average, at least 2. Their spread gives the standard error."""
    runs: int = 16
    """Number of independent runs of the finite differences, at least 2."""
    fd_spp: int = 1024
    """Samples per pixel of each image of the finite differences."""
    max_depth: int = 2
    """`max_depth` of the `path` integrator that the finite differences use."""
    tolerance: float = 0.01
    """Error that the step of the finite differences may cause, relative to the derivative."""
    out: Annotated[Path | None, arg(metavar="FILE.png")] = None
    """Picture to write, with the derivative, the finite differences, and their difference."""

    def run(self) -> int:
        at_least(1, spp=self.spp, fd_spp=self.fd_spp, max_depth=self.max_depth)
        at_least(2, seeds=self.seeds, runs=self.runs)
        if not 0 <= self.tolerance < 1:
            raise InputError(f"--tolerance must be >= 0 and < 1, got {self.tolerance:g}")
        if self.out:
            if self.out.suffix != ".png":
                raise InputError(f'--out: "{self.out}" must end in .png')
            _loading.check_output(self.out, folder=False)
        scene = self.load()
        integrator = load_integrator(self.integrator)
        motion = self.load_motion(scene)
        what = str(motion)

        start = time.perf_counter()
        derivatives = self._derivatives(scene, integrator, motion)
        seconds = [time.perf_counter() - start]
        start = time.perf_counter()
        differences = partial(
            self.reference, scene, motion, step=self.step, runs=self.runs, spp=self.fd_spp, max_depth=self.max_depth
        )
        reference = differences()
        seconds.append(time.perf_counter() - start)

        agreement = compare(derivatives, reference, tolerance=self.tolerance)
        faults = agreement.faults()
        width, height = scene.sensors()[self.sensor].film().crop_size()
        print(f"scene               {self.scene.name}, {width} x {height}")
        print(f"motion              {what}, per {motion.unit}")
        print(f"derivative          {self.integrator}, {self.seeds} x {self.spp} spp: {seconds[0]:.2f} s")
        print(f"finite differences  step {self.step:g}, {self.runs} runs of {self.fd_spp} spp: {seconds[1]:.2f} s")
        for name, value in agreement.numbers().items():
            print(f"{name:<19} {value}")
        print("result              " + (f"DISAGREE: {'; '.join(faults)}" if faults else "agree, within their noise"))
        if faults:
            self._look_at_both_sides(differences, derivatives)
        if self.out:
            _loading.make_folder(self.out.parent)
            with writing():
                self._write_panels(what, motion.unit, derivatives.mean(0), reference, agreement)
        return 1 if faults else 0

    def _derivatives(self, scene: Any, integrator: Any, motion: Motion) -> np.ndarray:
        """One for each seed: (N, H, W, C)."""
        renders = []
        with progress(list(range(self.seeds)), "derivative") as bar:
            for k in bar:
                launches = seeds(self.spp, self.pixels(scene), self.seed)
                launches = [(seed + k * len(launches), spp) for seed, spp in launches]
                render = lambda seed, spp: derivative_image(
                    scene, integrator, motion, sensor=self.sensor, spp=spp, seed=seed
                )
                renders.append(accumulate(render, launches, "launch"))
        return np.array(renders)

    def _look_at_both_sides(self, differences: Callable[..., FiniteDifferences], derivatives: np.ndarray) -> None:
        """Say whether the image has a derivative at all."""
        before, after = (differences(side=side) for side in (-1, 1))
        apart, noise = two_sides(before, after)
        print(f"both sides          differences before and after differ by {apart:.2%} (of noise: {noise:.2%})")
        if apart > BENDS + 2 * noise:
            sides = {"those before": before, "those after": after}
            agrees = [
                n for n, side in sides.items() if not compare(derivatives, side, tolerance=self.tolerance).faults()
            ]
            print(
                f"{'':<20}The image has no derivative here, or the step is too large: surfaces may begin to touch or "
                f"to part. The derivative agrees with {' and '.join(agrees) or 'neither'}."
            )

    def _write_panels(
        self, what: str, unit: str, derivative: np.ndarray, reference: FiniteDifferences, result: Agreement
    ) -> None:
        assert self.out is not None
        panels = [
            pictures.Panel(derivative, self.integrator, "derivative"),
            pictures.Panel(reference.mean, "finite differences", "derivative"),
            pictures.Panel(derivative - reference.mean, f"difference (rel. L1 {result.relative:.1%})", "derivative"),
        ]
        pictures.write_panels(self.out, panels, title=what, unit=unit)


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Make a page with derivative images and a fit. Takes about a minute."""

    out: Path = Path("demo")
    """Folder for index.html and the pictures."""

    def run(self) -> int:
        from rimlight.inverse import demo

        _loading.check_output(self.out, folder=True)
        use_variant("llvm_ad_rgb")
        with writing():
            demo.main(self.out)
        return 0


@dataclass(frozen=True)
class _Fit:
    """Fit pose, material, light or shape to pictures, as described by a TOML file."""


@dataclass(frozen=True)
class _Reproduce:
    """Run the fits of Li et al. 2018 (figures 1, 6 and 10). Writes a report of each and prints a table of all."""


@dataclass(frozen=True)
class _Reflectance:
    """Fit the weights of lobes to measured reflectance, or choose the lobes."""


@dataclass(frozen=True)
class _Ps:
    """Photometric stereo: find shape and reflectance from images under many lights."""


@dataclass(frozen=True)
class _Bench:
    """Compare speed and error with Mitsuba's own integrators on this machine. Takes about five minutes."""


def commands(argv: Sequence[str]) -> dict[str, type]:
    """Commands by their names. argv : for one whose options depend on a file that they name."""
    fit, reproduce, reflectance, ps, bench = _Fit, _Reproduce, _Reflectance, _Ps, _Bench
    if argv[:1] in (["fit"], ["reproduce"]):
        from . import _fit  # only now, since it imports much

        fit, reproduce = _fit.command(argv), _fit.Reproduce
    if argv[:1] == ["reflectance"]:
        from ._reflectance import Reflectance as reflectance
    if argv[:1] == ["ps"]:
        from ._ps import Ps as ps
    if argv[:1] == ["bench"]:
        from ._bench import Bench as bench
    return {
        "sys-info": SysInfo,
        "params": Params,
        "plan": PlanCommand,
        "render": Render,
        "gradient": Gradient,
        "check": Check,
        "finite-differences": FiniteDifferencesCommand,
        "fit": fit,
        "reproduce": reproduce,
        "reflectance": reflectance,
        "ps": ps,
        "bench": bench,
        "demo": Demo,
    }
