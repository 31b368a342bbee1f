"""Which integrator suits a scene: is its light found from the camera, or from the lights; and is it reflected once, or
several times?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.refusals import InputError

#: Light counts as found from the lights if light subpaths carry more than this part of it, in a block of pixels.
MOSTLY = 0.8

#: From this part of all light on, `bdpt` pays. In the scenes of the package where it does, it is 0.09 and more; in the
#: others, less than 0.0004.
PAYS = 0.02

#: Blocks along the film, and samples in each.
BLOCKS, SAMPLES = 32, 64

#: Up to this part of all light may be reflected more than once without a need for more than direct illumination.
FEW = 0.005


@dataclass(frozen=True)
class ImageAdvice:
    """Which integrator suits images of a scene, and its derivatives. `print` it.

    integrator : plugin for images.
    share : of the light that the sensor sees, how much is found from the lights.
    indirect : how much is reflected more than once.
    """

    integrator: str
    share: float
    indirect: float

    @property
    def derivative(self) -> str:
        """Plugin for derivatives."""
        if self.integrator == "bdpt":
            return "bdpt_edge"
        return "direct_edge" if self.indirect <= FEW else "prb_edge"

    @property
    def images(self) -> str:
        """What to say of images."""
        if self.integrator == "bdpt":
            found = f"{100 * self.share:.0f} % of the light that the sensor sees is found from the lights"
            return f"images: bdpt, since {found}, and hardly from the camera"
        return "images: path or prb_edge, since light samples from the camera find what bdpt would find, in less time"

    def __str__(self) -> str:
        part = f"{100 * self.indirect:.1f} % of the light that the sensor sees is reflected more than once"
        why = "for the same reason" if self.integrator == "bdpt" else f"since {part}"
        return f"{self.images}\nderivatives: {self.derivative}, {why}"


def image_advice(scene: mi.Scene, *, sensor: int = 0, max_depth: int = 6) -> ImageAdvice:
    """Which integrator suits images of a scene: `bdpt`, or `path` and those that render the same; and which suits their
    derivatives: `bdpt_edge`, `prb_edge` or `direct_edge`.

    It renders a small image by `bdpt`, and looks at which part of it those ways make that start at the camera, and
    which part is reflected more than once: a few seconds, most of them compilation. It looks at the image alone. What
    changes is not known to it, so a derivative may have other noise: `rimlight.inverse.advice` measures that.

    max_depth : of the paths, in segments; -1 stands for no limit.

    Raises
    ------
    ValueError : the variant is one that `bdpt` does not support.
    RuntimeError : so is the scene.
    """
    try:
        it = mi.load_dict({"type": "bdpt", "max_depth": max_depth})
    except RuntimeError as error:
        raise InputError(f"image_advice: {error}") from error
    size = scene.sensors()[sensor].film().crop_size()
    step = [max(1, -(-int(n) // BLOCKS)) for n in (size[1], size[0])]
    spp = max(1, SAMPLES // (step[0] * step[1]))

    def light(ways: tuple[int | None, int | None]) -> np.ndarray:
        it.ways = ways
        pixels = np.array(it.render(scene, sensor, seed=0, spp=spp), np.float64)[..., :3].sum(-1)
        pad = [(0, -n % s) for n, s in zip(pixels.shape, step, strict=True)]
        pixels = np.pad(pixels, pad)
        blocks = pixels.reshape(pixels.shape[0] // step[0], step[0], pixels.shape[1] // step[1], step[1])
        return blocks.sum((1, 3))

    total = light((None, None))
    from_camera = light((0, None)) + light((1, None))
    found = total - from_camera > MOSTLY * total
    part = lambda light: float(light.sum() / total.sum()) if total.any() else 0.0
    share = part(total[found])
    it.depths = replace(it.depths, max_depth=min(2, it.depths.max_depth))
    return ImageAdvice("bdpt" if share > PAYS else "path", share, max(1 - part(light((None, None))), 0.0))
