"""What the commands share: options, and work that is done in steps."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm
from tyro.conf import Positional, UseAppendAction, arg

import rimlight
from rimlight import pictures
from rimlight.checks import FiniteDifferences, Motion, finite_differences
from rimlight.exr import write_exr
from rimlight.loading import InputError, expected, load_scene, use_variant

from . import _loading
from ._loading import at_least

#: Samples of one launch. More are split, so that a progress bar can move and an interruption is heard.
MAX_SAMPLES = 2**20

#: Samples of one launch that finite differences may ask for: memory for the state of their sampler is needed at once.
MAX_REFERENCE_SAMPLES = 2**28

Numbers = Annotated[str | None, arg(metavar="X,Y,Z")]


# ------------------------------------------------------------------ shared options


@dataclass(frozen=True, kw_only=True)
class OnScene:
    scene: Annotated[Positional[Path], arg(metavar="SCENE.XML")]
    """Scene file of Mitsuba 3."""
    define: Annotated[UseAppendAction[tuple[str, ...]], arg(aliases=["-D"], metavar="KEY=VALUE")] = ()
    """Set a parameter of the scene file, such as res=128. May be repeated."""
    variant: str = "llvm_ad_rgb"
    """Variant of Mitsuba."""

    def load(self) -> Any:
        use_variant(self.variant)
        return load_scene(self.scene, self.define)


@dataclass(frozen=True, kw_only=True)
class OnSensor(OnScene):
    sensor: int = 0
    """Number of the sensor in the scene, from 0."""
    seed: int = 0
    """Random seed."""

    def load(self) -> Any:
        at_least(0, sensor=self.sensor, seed=self.seed)
        scene = super().load()
        if self.sensor >= len(scene.sensors()):
            raise InputError(
                f"--sensor: the scene has {len(scene.sensors())} sensors, there is no number {self.sensor}"
            )
        return scene

    def pixels(self, scene: Any) -> int:
        return int(np.prod(scene.sensors()[self.sensor].film().crop_size()))

    def metadata(self, **more: Any) -> dict[str, Any]:
        versions = {"rimlight": rimlight.__version__, "mitsuba": mi.__version__, "drjit": dr.__version__}
        return {"scene": self.scene, "define": " ".join(self.define), "variant": self.variant, **versions, **more}


@dataclass(frozen=True, kw_only=True)
class OnMotion(OnSensor):
    param: Annotated[str | None, arg(metavar="KEY")] = None
    """Parameter that changes, as `rimlight params` lists it."""
    camera: Literal["translate", "rotate"] | None = None
    """Move the camera instead of a parameter."""
    direction: Numbers = None
    """Displacement per unit of θ, in world space. For colours etc.: as many numbers as the parameter has, or one."""
    rotate: Numbers = None
    """Axis of a rotation, in world space. θ is in radians."""
    pivot: Numbers = None
    """Point on that axis. Default: the mean of the vertices, or the origin of what moves."""
    vertices: Annotated[str | None, arg(metavar="I,J,...")] = None
    """Move only these vertices. Default: all."""

    def load_motion(self, scene: Any) -> Motion:
        return _loading.load_motion(
            scene,
            param=self.param,
            camera=self.camera,
            direction=self.direction,
            rotate=self.rotate,
            pivot=self.pivot,
            vertices=self.vertices,
            sensor=self.sensor,
        )

    def reference(
        self,
        scene: Any,
        motion: Motion,
        *,
        step: float,
        runs: int,
        spp: int,
        max_depth: int,
        side: Literal[-1, 0, 1] = 0,
    ) -> FiniteDifferences:
        most = MAX_REFERENCE_SAMPLES // self.pixels(scene)
        if spp > most:
            raise InputError(
                f"finite differences: {spp} spp of this film exceed the limit of {most}; use more --runs instead"
            )
        return finite_differences(
            scene,
            motion,
            step=step,
            runs=runs,
            spp=spp,
            max_depth=max_depth,
            sensor=self.sensor,
            seed=self.seed,
            side=side,
            progress=sys.stderr.isatty(),
        )


# ------------------------------------------------------------------ work


def seeds(spp: int, pixels: int, first: int) -> list[tuple[int, int]]:
    """(seed, spp) of the launches that make up `spp`."""
    count = -(-spp * pixels // MAX_SAMPLES)
    count = min(count, spp)
    return [(first + i, spp // count + (i < spp % count)) for i in range(count)]


def accumulate(render: Callable[[int, int], Any], launches: list[tuple[int, int]], label: str) -> np.ndarray:
    """Mean of `render(seed, spp)` over the launches, weighted by spp: (H, W, C), float32."""
    total = np.float64(0)
    with progress(launches, label) as bar:
        for seed, spp in bar:
            with rimlight.no_collection():
                total = total + spp * np.array(render(seed, spp), np.float64)
    image = (total / sum(spp for _, spp in launches)).astype(np.float32)
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
        raise InputError(
            f"the film or integrator makes images of shape {image.shape}; 1, 3 or 4 channels are supported"
        )
    return image


def progress(items: list[Any], label: str) -> Any:
    """A bar on a terminal, after half a second; nothing elsewhere."""
    return tqdm(items, desc=label, leave=False, delay=0.5, disable=None)


@contextmanager
def writing() -> Iterator[None]:
    with expected(OSError, who="--out"):
        yield


def write_image(stem: Path, image: np.ndarray, metadata: dict[str, Any]) -> None:
    write_exr(stem.with_suffix(".exr"), {"": image}, metadata)
    pictures.write_image(stem.with_suffix(".png"), image)
