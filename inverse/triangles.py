"""Fitting mesh vertices to a picture: the smallest complete inverse-rendering loop, on Mitsuba's public interface."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm


@dataclass(frozen=True)
class VertexFit:
    """What `fit_vertices` found.

    losses : (iterations,), mean squared difference from the target before each step, the noise of the render included.
    history : key -> (iterations + 1, V, 3), world space; the vertices before each step, and at the end.
    image : (H, W, C), float32, linear; a render of the result, with `final_spp`.
    """

    losses: np.ndarray
    history: dict[str, np.ndarray]
    image: np.ndarray

    @property
    def positions(self) -> dict[str, np.ndarray]:
        """The fitted vertices: key -> (V, 3), world space."""
        return {key: steps[-1] for key, steps in self.history.items()}


def fit_vertices(
    scene: Any,
    keys: Sequence[str],
    target: Any,
    *,
    iterations: int = 200,
    learning_rate: float = 0.05,
    decay: float = 0.02,
    axes: str = "xyz",
    spp: int = 4,
    final_spp: int = 256,
    integrator: Any = None,
    sensor: int = 0,
    seed: int = 0,
    progress: bool = True,
) -> VertexFit:
    """Move vertices until the scene looks like a picture, by Adam on the mean squared difference of the pixels.

    Every step renders once forward and once backward, with different random numbers, so that the gradient has no bias.

    Parameters
    ----------
    scene : mi.Scene. Its vertices are the start; they are left at the result.
    keys : vertex positions to fit, as `mi.traverse(scene)` names them.
    target : (H, W, C), linear radiance, of the size of the sensor's film.
    iterations : number of steps.
    learning_rate : length of the first steps, scene units. It falls exponentially, to `decay` times that at the end.
    axes : the coordinates that may change, world space. One picture says little about depth: "xy", say, holds it.
    spp, final_spp : samples per pixel of a step, and of the image that is returned.
    integrator : mi.Integrator. Default: `direct_edge`.
    sensor, seed : which sensor, and where the random numbers start.
    progress : show a bar on standard error.

    Raises
    ------
    ValueError : a key is unknown or no vertex position, the target has another shape or is not finite, or a number is
        out of range.
    RuntimeError : the loss is no longer finite.
    """
    for name, value in {"iterations": iterations, "spp": spp, "final_spp": final_spp}.items():
        if value < 1:
            raise ValueError(f'fit_vertices: "{name}" must be >= 1, got {value}')
    for name, value in {"learning_rate": learning_rate, "decay": decay}.items():
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f'fit_vertices: "{name}" must be > 0, got {value}')
    if not axes or set(axes) - set("xyz"):
        raise ValueError(f'fit_vertices: "axes" must consist of the letters x, y, z, got "{axes}"')
    params = mi.traverse(scene)
    _check_keys(params, keys)
    integrator = integrator or mi.load_dict({"type": "direct_edge"})
    render = lambda seed, spp: mi.render(scene, params, sensor=sensor, integrator=integrator, seed=seed, spp=spp)
    target = mi.TensorXf(_check_target(target, scene.sensors()[sensor].film()))

    optimiser = mi.ad.Adam(lr=learning_rate)
    for key in keys:
        optimiser[key] = params[key]
    params.update(optimiser)
    free = {key: np.tile([axis in axes for axis in "xyz"], dr.width(params[key]) // 3) for key in keys}
    history = {key: [_vertices(params[key])] for key in keys}
    losses = []
    for i in (bar := tqdm(range(iterations), desc="fit", disable=None if progress else True)):
        optimiser.set_learning_rate(learning_rate * decay ** (i / max(iterations - 1, 1)))
        loss = dr.mean(dr.square(render(seed + i, spp) - target), axis=None)
        dr.backward(loss)
        losses.append(float(loss.array[0]))
        if not np.isfinite(losses[-1]):
            raise RuntimeError(f"fit_vertices: the loss is {losses[-1]} after {i} steps")
        for key in keys:
            dr.set_grad(optimiser[key], dr.select(mi.Bool(free[key]), dr.grad(optimiser[key]), 0))
        optimiser.step()
        params.update(optimiser)
        for key in keys:
            history[key].append(_vertices(params[key]))
        bar.set_postfix(loss=f"{losses[-1]:.2e}", refresh=False)

    for key in keys:
        params[key] = dr.detach(params[key])
    params.update()
    image = np.array(render(seed + iterations, final_spp))
    return VertexFit(np.array(losses), {key: np.stack(steps) for key, steps in history.items()}, image)


def _check_keys(params: Any, keys: Sequence[str]) -> None:
    if isinstance(keys, str) or not keys:
        raise ValueError(f'fit_vertices: "keys" must be a list of names, got {keys!r}')
    for key in keys:
        if key not in params:
            close = difflib.get_close_matches(key, list(params.keys()), n=2, cutoff=0.4)
            raise ValueError(
                f'fit_vertices: unknown parameter "{key}"' + (f", did you mean {' or '.join(close)}?" if close else "")
            )
        if not key.endswith("vertex_positions"):
            raise ValueError(f'fit_vertices: "{key}" holds no vertex positions')


def _check_target(target: Any, film: Any) -> np.ndarray:
    target = np.asarray(target, np.float32)
    width, height = film.crop_size()
    if target.ndim != 3 or target.shape[:2] != (height, width):
        raise ValueError(f"fit_vertices: the target must be of shape ({height}, {width}, C), got {target.shape}")
    if not np.isfinite(target).all():
        raise ValueError("fit_vertices: the target is not finite")
    return target


def _vertices(positions: mi.Float) -> np.ndarray:
    return np.array(dr.detach(positions)).reshape(-1, 3)
