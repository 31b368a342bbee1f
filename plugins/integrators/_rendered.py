"""Is a scene still what it was when the image was rendered whose derivative is asked for?"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.geometry.parameters import parameters

#: Images that are remembered at most, until their derivatives are asked for.
KEPT = 256

CHANGED = (
    "the scene has changed since the image was rendered whose derivative is asked for: the derivative is that of the "
    "scene as it is now. Differentiate each image before you change the scene for the next one."
)


class Rendered:
    """Remembers of which parameters images were rendered.

    `mi.render` asks for the image at once, and for its derivative later, by which time a script may have set the next
    pose. All that both requests have in common is the sensor, and the seed, from which `mi.render` makes that of the
    derivative. So nothing is known of images with a `seed_grad` of their own, and in frozen functions.
    """

    #: Nothing, for `dr.freeze`.
    DRJIT_STRUCT = dict.fromkeys(())

    def __init__(self) -> None:
        self._states: dict[tuple[int, int], list[Any]] = {}

    def remember(self, scene: mi.Scene, sensor: mi.Sensor, seed: Any) -> None:
        """An image is rendered."""
        if isinstance(seed, int) and not dr.flag(dr.JitFlag.FreezingScope):
            key = id(sensor), mi.sample_tea_32(seed, 1)[0]
            self._states.pop(key, None)
            self._states[key] = _state(scene, sensor)
            if len(self._states) > KEPT:
                del self._states[next(iter(self._states))]

    def has_changed(self, scene: mi.Scene, sensor: mi.Sensor, seed: Any) -> bool:
        """The derivative of an image is asked for. Has the scene changed since?"""
        before = self._states.pop((id(sensor), seed), None) if isinstance(seed, int) else None
        return before is not None and before != _state(scene, sensor)


def _state(scene: mi.Scene, sensor: mi.Sensor) -> list[Any]:
    """Numbers that are others after a parameter was replaced."""
    found = parameters(scene)
    if not any(p.node is sensor for p in found):
        found = [*found, *parameters(sensor)]
    return [_number(p.value) for p in found]


def _number(value: Any) -> Any:
    value = getattr(value, "matrix", value)
    if value is not None and dr.is_tensor_v(value):
        return value.array.index
    if value is None or not dr.is_array_v(value):
        return value if isinstance(value, int | float | str) else None
    return value.index if dr.is_jit_v(value) and dr.depth_v(value) == 1 else [_number(v) for v in value]
