"""Derivatives do not depend on how light is divided."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mitsuba as mi
import numpy as np
import pytest

from rimlight.checks import Motion, derivative_image


def assert_same_derivative(
    make: Callable[[], mi.Scene],
    motion: dict,
    monkeypatch: pytest.MonkeyPatch,
    number: str,
    values: Sequence[float],
    runs: int = 12,
) -> None:
    """With two values of a number, given by its name. What the camera sees directly is left out."""
    images = []
    for value in values:
        monkeypatch.setattr(number, value)
        room, integrator = make(), mi.load_dict({"type": "direct_edge", "sppp": 0})
        moves = Motion(room, **motion)
        images.append(np.array([derivative_image(room, integrator, moves, spp=64, seed=i) for i in range(runs)], float))
    # The mean of all would lean to the one with more noise.
    by_noise = [1 / i.var(0, ddof=1).sum() for i in images]
    both = np.average([i.mean(0) for i in images], axis=0, weights=by_noise)
    scales = [(i * both).sum((1, 2, 3)) / (both**2).sum() for i in images]
    error = sum(s.var(ddof=1) / len(s) for s in scales) ** 0.5
    assert error < 0.02
    assert abs(scales[0].mean() - scales[1].mean()) < 4 * error
