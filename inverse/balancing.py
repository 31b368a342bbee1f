"""How the samples of a fit are divided among the parts of the derivative."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from . import free_parameters
from .free_parameters import to_numpy
from .renderer import Renderer, Task
from .view import derived_seed

if TYPE_CHECKING:
    from .fitting import Fit

log = logging.getLogger(__name__)


def divide(fit: Fit, task: Task, before: Mapping[str, np.ndarray]) -> None:
    """Measure the noise of each part along a step that was just taken, and note the shares: see `Problem.balance`.

    task : a render of that step. before : latents from which it was taken.
    """
    now = fit.progress
    now.balanced = now.segment
    latents = fit.latents()
    measured = replace(task, seed=derived_seed(task.seed, 2**31 + 3), show=False, doubt=False)
    try:
        call = task.target, fit.values(latents), way(fit, before, latents)
        (shares,) = fit.executor.map(_shares, measured, [call])
    except RuntimeError as error:  # nothing was seen to change, say
        log.warning("the samples are not divided anew: %s", error)
    else:
        now.shares = dict(shares)
        log.info("samples of each part of the derivative: %s", ", ".join(f"{k} x {v:.2f}" for k, v in shares))


def _shares(
    renderer: Renderer, task: Task, target: int, values: Mapping[str, np.ndarray], change: Mapping[str, np.ndarray]
) -> tuple[tuple[str, float], ...]:
    return renderer.balance(values, change, task)


def way(fit: Fit, before: Mapping[str, np.ndarray], latents: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Derivatives of the scene parameters on the straight way between two states of a fit, at the second one."""
    held = {name: mi.Float(latent) for name, latent in latents.items()}
    for name, latent in held.items():
        dr.enable_grad(latent)
        dr.set_grad(latent, mi.Float(latents[name] - before[name]))
    found = free_parameters.values(fit.parameters, held)
    dr.forward_to(found)
    return {key: to_numpy(dr.grad(value)) for key, value in found.items()}
