"""The last guard: what an integrator returns is counted if it is not finite, and reported. Nothing is masked."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def values_of(params: Any) -> dict[str, Any]:
    """The parameters that have a value, by name. A single array has the name "parameter"."""
    if not isinstance(params, mi.SceneParameters):
        return {} if params is None else {"parameter": params}
    # Not by their names: some (of `hair`) are without a value, at which Mitsuba 3.9 stumbles.
    rows = params.properties.items()
    values = {key: mi.get_property(value, kind, node) if kind else value for key, (value, kind, node, _) in rows}
    return {key: value for key, value in values.items() if value is not None}


def report_image(who: str, image: mi.TensorXf) -> None:
    """Warn if numbers of a derivative image are not finite."""
    _report(who, {"the derivative image": image})


def report_gradients(who: str, params: Any) -> None:
    """Warn if numbers of the gradients of the parameters are not finite."""
    values = {key: v for key, v in values_of(params).items() if dr.grad_enabled(v)}
    _report(who, {f'the gradient of "{key}"': dr.grad(getattr(v, "matrix", v)) for key, v in values.items()})


def _report(who: str, arrays: dict[str, Any]) -> None:
    if dr.flag(dr.JitFlag.FreezingScope) or not arrays:
        return  # what is recorded cannot be looked at
    with dr.suspend_grad():
        arrays = {name: dr.ravel(a) for name, a in arrays.items()}
        counts = {name: dr.count(~dr.isfinite(a)) for name, a in arrays.items()}
        for name, count in counts.items():
            if count[0]:
                mi.Log(
                    mi.LogLevel.Warn,
                    f"{who}: {count[0]} of {dr.width(arrays[name])} numbers of {name} are not finite. This is a defect "
                    "of the integrator, unless the scene or the loss hold such numbers: please report it, with scene "
                    "and seed. Another seed may help until then.",
                )
