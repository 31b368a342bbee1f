"""What Rimlight runs on: versions, hardware, and which parts can be used."""

from __future__ import annotations

import importlib
import importlib.metadata
import platform
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

import rimlight
from rimlight import _llvm

PACKAGES = {  # name to show -> distribution
    "Mitsuba": "mitsuba",
    "Dr.Jit": "drjit",
    "NumPy": "numpy",
    "OpenEXR": "OpenEXR",
    "Matplotlib": "matplotlib",
    "tqdm": "tqdm",
    "tyro": "tyro",
}


def sys_info() -> dict[str, Any]:
    """Collect the facts that a bug report or a benchmark has to state.

    Returns
    -------
    dict with the entries

    * ``versions``: name -> version, "not installed" where missing;
    * ``system``, ``processor``: text; ``threads``: number of threads of Dr.Jit;
    * ``llvm``: None, or a dict of ``path``, ``version``, ``origin``;
    * ``variants``: the variants that Mitsuba was compiled with;
    * ``usable``: part -> None if it works, else the reason why it does not.
    """
    llvm = _llvm.active()
    return {
        "versions": {
            "Rimlight": rimlight.__version__,
            "Python": platform.python_version(),
            **{name: _version(distribution) for name, distribution in PACKAGES.items()},
        },
        "system": platform.platform(),
        "processor": processor(),
        "threads": dr.thread_count(),
        "llvm": llvm and {"path": llvm.path, "version": ".".join(map(str, llvm.version)), "origin": llvm.origin},
        "variants": list(mi.variants()),
        "usable": {
            "LLVM backend": _reason(lambda: _run_kernel("LLVM")),
            "CUDA backend": _reason(lambda: _run_kernel("CUDA")),
            "OpenEXR": _reason(lambda: importlib.import_module("OpenEXR")),
            "Matplotlib": _reason(lambda: importlib.import_module("matplotlib.figure")),
        },
    }


def print_sys_info() -> None:
    """Print `sys_info` as aligned text."""
    info = sys_info()
    llvm = info["llvm"]
    print("\n".join(_section("Versions", info["versions"])))
    machine = {
        "System": info["system"],
        "Processor": info["processor"],
        "Threads": info["threads"],
        "LLVM": f"{llvm['version']} ({llvm['origin']})" if llvm else "none",
    }
    if llvm:
        machine["LLVM file"] = llvm["path"]
    print("\n".join(_section("Machine", machine)))
    print("\n".join(_section("Usable", {part: f"no: {why}" if why else "yes" for part, why in info["usable"].items()})))
    print("\n".join(["Variants", *(f"  {variant}" for variant in info["variants"])]))


def _section(title: str, rows: dict[str, Any]) -> list[str]:
    return [title, *(f"  {name:<13} {value}" for name, value in rows.items()), ""]


def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def processor() -> str:
    """Marketing name of the processor, where the system tells it."""
    try:
        if platform.system() == "Linux":
            for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
        if platform.system() == "Darwin":
            command = ["/usr/sbin/sysctl", "-n", "machdep.cpu.brand_string"]
            return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        pass
    return platform.processor() or platform.machine()


def _reason(attempt: Callable[[], object]) -> str | None:
    """None if `attempt` succeeds, else the first line of its error."""
    try:
        attempt()
    except Exception as error:
        return (str(error).strip() or type(error).__name__).splitlines()[0]
    return None


def _run_kernel(backend: str) -> None:
    """Compile and run one line on a backend, whatever the variant of Mitsuba."""
    if not dr.has_backend(getattr(dr.JitBackend, backend)):
        raise RuntimeError("no usable LLVM library" if backend == "LLVM" else "no driver, or no device")
    Float = importlib.import_module(f"drjit.{backend.lower()}").Float
    if (result := list(dr.minimum(dr.opaque(Float, 2, 3) + 1, 4))) != [3, 3, 3]:
        raise RuntimeError(f"computed {result} in place of [3, 3, 3]")
