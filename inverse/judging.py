"""Which of two states of a fit is better, the noise of their pictures apart.

The loss at a picture with noise contains the variance of that noise, which may be less where the fit is worse: of a
dark lamp, say. The mean of two independent pictures a, b has half of their variance. So

    2 loss((a + b) / 2) - (loss(a) + loss(b)) / 2

does not contain it, exactly if the loss is a mean of squares, and to first order in the variance if it is another one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from . import batches, free_parameters
from .regularisers import penalty_of
from .renderer import Renderer, Task
from .view import derived_seed

if TYPE_CHECKING:
    from .fitting import Fit

#: Pairs of pictures of each view that are compared.
PAIRS = 4

#: Standard errors by which a state must be better than the last one for a fit to go back to it.
SURE = 4.0


def is_better(fit: Fit, latents: Mapping[str, np.ndarray]) -> bool:
    """Are other latents better than the present ones, and is that sure?"""
    now = fit.progress
    tasks = batches.tasks(fit.problem, now.step, fit.plan[now.segment], doubt=(), show=False, shares={})
    states = [fit.values(at) for at in (fit.latents(), latents)]
    # Of both states with the same random numbers
    calls = [
        (task.target, replace(task, seed=derived_seed(task.seed, k)), state)
        for k in range(PAIRS)
        for state in range(2)
        for task in tasks
    ]
    losses = np.reshape(fit.executor.map(_loss, states, calls), (PAIRS, 2, len(tasks))).mean(2)
    gained = losses[:, 0] - losses[:, 1] + _penalty(fit, fit.latents()) - _penalty(fit, latents)
    return not gained.mean() <= SURE * gained.std(ddof=1) / np.sqrt(PAIRS)


def _loss(renderer: Renderer, states: Sequence[Mapping[str, np.ndarray]], _: int, task: Task, state: int) -> float:
    pictures = [renderer.image(states[state], t) for t in (task, replace(task, seed=derived_seed(task.seed)))]
    compared = renderer.views[task.target].compared
    of_mean, *of_each = (compared(p, task.stage)[0] for p in (0.5 * (pictures[0] + pictures[1]), *pictures))
    return 2 * of_mean - sum(of_each) / 2


def _penalty(fit: Fit, latents: Mapping[str, np.ndarray]) -> float:
    """Of the regularisers."""
    held = {name: mi.Float(latent) for name, latent in latents.items()}
    penalty = penalty_of(fit.regularisers, free_parameters.values(fit.parameters, held))
    return 0.0 if penalty is None else float(np.array(dr.detach(penalty)).item())
