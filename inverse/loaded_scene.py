"""A scene in memory, whose parameters a fit sets: once for all views of it that a step renders."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .free_parameters import from_flat, to_numpy


class LoadedScene:
    """A scene, and the integrator that renders it: ours remember the edges of the last scene.

    params : `mi.traverse(scene)`.
    """

    def __init__(self, scene: mi.Scene, integrator: mi.Integrator):
        self.scene, self.integrator = scene, integrator
        self.params = mi.traverse(scene)
        self._initial: dict[str, Any] = {}  # of what has been set
        self._changed = False
        self._arranged: set[tuple[int, str]] = set()

    def here(self, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The values of parameters that this scene has."""
        return {key: value for key, value in values.items() if key in self.params}

    def set(self, values: Mapping[str, np.ndarray], wanted: Collection[str] | None = None) -> dict[str, mi.Float]:
        """Set parameters: key -> array as `to_numpy` makes it. Returns what collects the gradients: key -> flat.

        wanted : keys of parameters whose gradients are wanted. Default: all.
        """
        leaves = {}
        for key, value in self.here(values).items():
            if key not in self._initial:
                old = self.params[key]
                self._initial[key] = type(old)(dr.detach(old))  # a copy: Mitsuba writes into the old one
            old = self._initial[key]
            # Multiplied, so that it lies in Dr.Jit's own memory: of NumPy's, a replay would see the first numbers only.
            leaf = mi.Float(value.astype(np.float32).ravel()) * dr.opaque(mi.Float, 1)
            dr.eval(leaf)
            if wanted is None or key in wanted:
                dr.enable_grad(leaf)
                leaves[key] = leaf
            self.params[key] = from_flat(leaf, type(old), old.shape if dr.is_tensor_v(old) else None)
        self.params.update()
        self._changed = True
        return leaves

    def reset(self) -> None:
        """Make the scene as it was loaded."""
        if self._changed:
            for key, value in self._initial.items():
                self.params[key] = type(value)(value)
            self.params.update()
            self._changed = False

    def arrange(self, view: int, values: Mapping[str, np.ndarray], find_boundaries: Callable[[], Any]) -> None:
        """Have the integrator find the edges of a view before these parameters first change.

        It arranges them when it first sees them, and its random samples depend on that: it shall be the same for all
        who compute, whenever they begin.
        """
        here = self.here(values)
        if not {(view, key) for key in here} <= self._arranged:
            self.set({key: to_numpy(self._initial.get(key, self.params[key])) for key in here})
            find_boundaries()
            self._arranged |= {(view, key) for key in here}
