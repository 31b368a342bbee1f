"""Cost of `ggx_dictionary`:  python tests/benchmarks/bm_reflectance.py [--quick]

Values of materials at four million pairs of directions, and gradients with respect to a parameter and to the normals.
Seconds of the processor, so that what else the machine does counts less.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import numpy as np
from _bench import Benchmark, Settings, duration, main, say, table

from rimlight import ggx

PAIRS, CALLS = 1 << 22, 5


def dictionary(lobes: ggx.Lobes) -> dict[str, Any]:
    weights = mi.TensorXf(dr.full(mi.Float, 1 / len(lobes), 3 * len(lobes)), shape=(len(lobes), 3))
    return {"type": "ggx_dictionary", "weights": weights, "alpha": mi.Float(lobes.alpha), "eta": mi.Float(lobes.eta)}


def different(count: int) -> Callable[[], dict[str, Any]]:
    """Lobes that share nothing, and a Lambertian one."""
    alphas, etas = np.geomspace(0.01, 1, count).tolist(), np.geomspace(1.1, 20, count).tolist()
    return lambda: dictionary(ggx.Lobes((*alphas, np.nan), (*etas, np.nan)))


def shipped() -> dict[str, Any]:
    return dictionary(ggx.read_dictionary()[0])


#: Name -> material, and the parameter with respect to which it is differentiated.
MATERIALS = {
    "`diffuse`": (lambda: {"type": "diffuse"}, "reflectance.value"),
    "`roughplastic`": (lambda: {"type": "roughplastic", "distribution": "ggx"}, "diffuse_reflectance.value"),
    "`principled`": (lambda: {"type": "principled", "specular": 0.5}, "base_color.value"),
    "`blinn_phong`": (lambda: {"type": "blinn_phong"}, "diffuse_reflectance.value"),
    "1 lobe and the Lambertian one": (different(1), "weights"),
    "4 lobes that share nothing": (different(4), "weights"),
    "the package's 40 lobes": (shipped, "weights"),
    "39 lobes that share nothing": (different(39), "weights"),
}


def measure(name: str, settings: Settings, _: Path) -> dict[str, Any]:
    make, key = MATERIALS[name]
    bsdf = mi.load_dict(make())
    other = mi.load_dict({"type": "diffuse"})  # with one material alone, calls would not be virtual
    params, pairs = mi.traverse(bsdf), PAIRS >> (6 if settings.quick else 0)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, pairs)
    wi, wo, normal = (mi.warp.square_to_uniform_hemisphere(sampler.next_2d()) for _ in range(3))
    normal = dr.normalize(mi.Vector3f(0, 0, 1) + 0.1 * normal)
    which = dr.select(dr.arange(mi.UInt32, pairs) == 0, mi.BSDFPtr(other), mi.BSDFPtr(bsdf))
    dr.eval(wi, wo, normal, which)

    def value() -> mi.Spectrum:
        si, frame = dr.zeros(mi.SurfaceInteraction3f, pairs), mi.Frame3f(normal)
        si.wi = frame.to_local(wi)
        return which.eval(mi.BSDFContext(), si, frame.to_local(wo))

    def gradient(leaf: Any) -> Any:
        dr.enable_grad(leaf)
        params.update()
        dr.backward(dr.sum(value(), axis=None))
        result = dr.grad(leaf)
        dr.eval(result)
        dr.disable_grad(leaf)
        return result

    found: dict[str, Any] = {"name": name}
    jobs = {"value": value, "parameter": lambda: gradient(params[key]), "normals": lambda: gradient(normal)}
    for job, function in jobs.items():
        seconds = [_processor_seconds(function) for _ in range(CALLS + 1)]
        found[job], found[f"{job}_first"] = float(np.median(seconds[1:])), seconds[0]
    say(str(found))
    return {"row": found}


def _processor_seconds(function: Callable[[], Any]) -> float:
    dr.sync_thread()
    start = time.process_time()
    dr.eval(function())
    dr.sync_thread()
    return time.process_time() - start


def report(found: dict[str, Any]) -> list[str]:
    time_of = lambda key: lambda r: duration(r[key])
    columns = {
        "<material": lambda r: r["name"],
        "value": time_of("value"),
        "first call": time_of("value_first"),
        "gradient by a parameter": time_of("parameter"),
        "first call ": time_of("parameter_first"),
        "gradient by normals": time_of("normals"),
        "first call  ": time_of("normals_first"),
    }
    return table(columns, [case["row"] for case in found.values()])


if __name__ == "__main__":
    main(Benchmark(name="reflectance", cases={n: partial(measure, n) for n in MATERIALS}, report=report))
