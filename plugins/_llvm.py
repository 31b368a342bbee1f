"""The LLVM library that Dr.Jit compiles with, chosen before Dr.Jit looks for one itself.

Dr.Jit takes the first ``libLLVM`` that the system offers, the moment ``drjit`` is imported. With LLVM 14 its LLVM
backend stays off, and with 15 and 16 the whole process is aborted (``Cannot select: fminimum``) by the first kernel
that contains a minimum, on processors with AVX-512. This module names a good library in ``DRJIT_LIBLLVM_PATH`` first.
"""

from __future__ import annotations

import ctypes
import glob
import importlib.metadata
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, MutableMapping
from dataclasses import dataclass
from pathlib import Path

MIN_MAJOR = 17
VARIABLE = "DRJIT_LIBLLVM_PATH"
PACKAGE = "karellen-llvm-core"
REMEDY = f"Run `pip install {PACKAGE}`, or set {VARIABLE} to the file of an LLVM >= {MIN_MAJOR}."
ATOMIC = "Install libatomic; on Debian and Ubuntu: apt install libatomic1."

# Dr.Jit switches its LLVM backend off when the variable names a file that does not exist; its own search is not run.
DISABLED = f"{os.sep}no-usable-llvm{os.sep}libLLVM.so"

ORIGIN_VARIABLE = VARIABLE
ORIGIN_ENVIRONMENT = "Python environment"
ORIGIN_SYSTEM = "system"
ORIGIN_DRJIT = "found by Dr.Jit"


@dataclass(frozen=True)
class LLVM:
    """An LLVM library that Dr.Jit can use."""

    path: str  # file, as handed to the dynamic loader
    version: tuple[int, int, int]  # major, minor, patch
    origin: str  # who named it: one of the ORIGIN_* texts

    def __str__(self) -> str:
        return f"LLVM {'.'.join(map(str, self.version))} ({self.path}, {self.origin})"


# ------------------------------------------------------------------ version of a file


def version_in_name(path: str) -> int | None:
    """Major version that a file name states (``libLLVM-14.so.1``, ``libLLVM.so.23.1``), ``None`` if it states none."""
    for name in (Path(path).resolve().name, Path(path).name):
        if match := re.match(r"libLLVM[-.](?:so\.)?(\d+)", name):
            return int(match[1])
    return None


def inspect(path: str) -> tuple[int, int, int]:
    """Version of the LLVM library at `path`.

    Old libraries are refused by their name, without being loaded: that costs up to 200 ms and 50 MB each. A library
    that passes is loaded here; it is the one that Dr.Jit loads next, and the loader does so once.

    Raises
    ------
    ValueError
        The file is missing, cannot be loaded, is no LLVM, or is too old. The text continues "it ...".
    """
    if os.path.dirname(path) and not os.path.isfile(path):
        raise ValueError("does not exist")
    named = version_in_name(path)
    if named is not None and named < MIN_MAJOR:
        raise ValueError(f"is LLVM {named}, and Dr.Jit needs LLVM >= {MIN_MAJOR}")
    try:
        library = _load(path)
    except OSError as error:
        raise ValueError(f"cannot be loaded ({error})") from None
    try:
        get_version = library.LLVMGetVersion  # exported since LLVM 16
    except AttributeError:
        raise ValueError("is no LLVM library, or one older than LLVM 16") from None
    numbers = [ctypes.c_uint() for _ in range(3)]
    get_version(*map(ctypes.byref, numbers))
    major, minor, patch = (number.value for number in numbers)
    if major < MIN_MAJOR:
        raise ValueError(f"is LLVM {major}, and Dr.Jit needs LLVM >= {MIN_MAJOR}")
    return major, minor, patch


def _load(path: str) -> ctypes.CDLL:
    """Load a library, also from a package on PyPI whose installation is not complete.

    The package makes the link ``libc++.so.1`` at the first start of Python after its installation. That fails in a
    folder without write permission, or under ``python -W error``. Loaded before, the libraries need no link.
    """
    try:
        return ctypes.CDLL(path)
    except OSError:
        for name in ("libunwind", "libc++abi", "libc++"):  # each needs those before it
            for file in glob.glob(os.path.join(glob.escape(os.path.dirname(path)), "*-linux-*", f"{name}.so.1.0")):
                ctypes.CDLL(file)
        return ctypes.CDLL(path)


# ------------------------------------------------------------------ places to look


def environment_libraries() -> Iterator[str]:
    """Libraries that belong to this Python environment: those of the package on PyPI, then the environment's own."""
    try:
        package = importlib.metadata.distribution(PACKAGE)
    except importlib.metadata.PackageNotFoundError:
        pass
    else:
        for file in package.files or ():
            if file.name.startswith("libLLVM"):
                yield str(Path(str(package.locate_file(file))).resolve())
    # Under a system interpreter this folder belongs to the system, and is searched as such
    if sys.prefix != sys.base_prefix or os.path.isdir(os.path.join(sys.prefix, "conda-meta")):
        yield from newest_first(glob.glob(os.path.join(sys.prefix, "lib", "libLLVM[-.]*")))


def system_libraries() -> list[str]:
    """Libraries in the usual places of Linux distributions, Homebrew and the LLVM installer for Windows."""
    if sys.platform == "win32":
        patterns = [r"C:\Program Files\LLVM\bin\LLVM-C.dll"]
    elif sys.platform == "darwin":
        patterns = [f"{root}/opt/llvm*/lib/libLLVM[-.]*dylib" for root in ("/opt/homebrew", "/usr/local")]
    else:
        folders = ("/usr/local/lib", "/usr/lib/*-linux-gnu", "/usr/lib64", "/usr/lib", "/usr/lib*/llvm*/lib*")
        patterns = [f"{folder}/libLLVM[-.]*so*" for folder in folders]
    return newest_first(file for pattern in patterns for file in glob.glob(pattern))


def newest_first(files: Iterable[str]) -> list[str]:
    """Distinct files, newest LLVM first, those without a version in their name last."""
    distinct = {os.path.realpath(file): file for file in files}
    return sorted(distinct.values(), key=lambda file: (version_in_name(file) or 0, file), reverse=True)


# ------------------------------------------------------------------ choice


def find(
    *,
    variables: MutableMapping[str, str] | None = None,
    environment: Callable[[], Iterable[str]] = environment_libraries,
    system: Callable[[], Iterable[str]] = system_libraries,
) -> LLVM:
    """Choose a library: the one named in ``DRJIT_LIBLLVM_PATH``, the Python environment's, the system's newest.

    Parameters
    ----------
    variables : environment variables, default `os.environ`. Not changed.
    environment, system : functions that list the files to try, best first.

    Raises
    ------
    ImportError
        Nothing usable was found. The text lists what was refused and why, and the remedy.

    Warns
    -----
    RuntimeWarning
        ``DRJIT_LIBLLVM_PATH`` names a library that cannot be used, and another one is used instead.
    """
    named = (os.environ if variables is None else variables).get(VARIABLE, "")
    places: list[tuple[str, Callable[[], Iterable[str]]]] = [
        # An empty variable is no choice to Dr.Jit either; DISABLED was set by a parent process of ours
        (ORIGIN_VARIABLE, lambda: [named] if named not in ("", DISABLED) else []),
        (ORIGIN_ENVIRONMENT, environment),
        (ORIGIN_SYSTEM, system),
    ]
    refused: dict[str, str] = {}
    for origin, files in places:
        for file in files():
            if file in refused:
                continue
            try:
                llvm = LLVM(file, inspect(file), origin)
            except ValueError as error:
                refused[file] = str(error)
                continue
            if named in refused:
                warnings.warn(
                    f"rimlight: {VARIABLE} is ignored: {named} {refused[named]}. Using {llvm} instead.",
                    RuntimeWarning,
                    stacklevel=2,
                )
            return llvm
    reasons = "".join(f"\n  {file} {reason}" for file, reason in refused.items())
    # That of the Python environment is there then, and small containers lack what it needs
    remedy = ATOMIC if "libatomic" in reasons else REMEDY
    raise ImportError(f"rimlight: no usable LLVM library (>= {MIN_MAJOR}) was found. {remedy}{reasons}")


def other_backend() -> str | None:
    """Name of a backend of Dr.Jit that works without LLVM on this machine: CUDA, Metal, or ``None``."""
    if sys.platform == "darwin":
        return "Metal"
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return None
    return "CUDA"


# ------------------------------------------------------------------ effect

_active: LLVM | None = None


def active() -> LLVM | None:
    """The library in use, ``None`` if the LLVM backend is disabled."""
    return _active


def activate() -> LLVM | None:
    """Make Dr.Jit use a good LLVM, best called before `drjit` is imported. Later calls change nothing.

    Returns
    -------
    The library, or ``None`` if there is none and Dr.Jit has to do with another backend (a warning says so).

    Raises
    ------
    ImportError
        There is neither a usable LLVM nor a driver for another backend.
    RuntimeError
        Dr.Jit was imported earlier, without a usable LLVM, and it is too late to give it one.
    """
    global _active
    if _active is None:
        _active = _adopt() if "drjit" in sys.modules else _choose()
    return _active


def _choose() -> LLVM | None:
    """Name the library, or the lack of one, in the variable that Dr.Jit reads."""
    try:
        llvm = find()
    except ImportError as error:
        backend = other_backend()
        if backend is None:
            raise
        if os.environ.get(VARIABLE) != DISABLED:
            warnings.warn(f"{error}\nOnly the {backend} backend can be used.", RuntimeWarning, stacklevel=2)
            os.environ[VARIABLE] = DISABLED
        _wait_for_drjit()
        return None
    os.environ[VARIABLE] = llvm.path
    return llvm


def _adopt() -> LLVM | None:
    """As `_choose`, for a Dr.Jit that was imported earlier and has made its own choice."""
    import drjit as dr

    _wait_for_drjit()
    usable = dr.has_backend(dr.JitBackend.LLVM)
    found = dr.detail.llvm_version()
    if usable and found[0] >= MIN_MAJOR:
        named = os.environ.get(VARIABLE, "")
        return LLVM(named or "unknown file", found, ORIGIN_VARIABLE if named else ORIGIN_DRJIT)
    # Dr.Jit loads LLVM once. It can be restarted only through functions that it does not expose to Python.
    state = f"already uses LLVM {found[0]}" if usable else "found no LLVM and disabled its LLVM backend"
    message = (
        f"rimlight: Dr.Jit {state}, where LLVM >= {MIN_MAJOR} is needed. Import `rimlight` before `mitsuba` and "
        f"`drjit`, or {_setting()} before Python starts."
    )
    backend = None if usable else other_backend()
    if backend is None:
        raise RuntimeError(message)
    warnings.warn(f"{message}\nOnly the {backend} backend can be used.", RuntimeWarning, stacklevel=2)
    return None


def _wait_for_drjit() -> None:
    """Wait until Dr.Jit, which starts in a thread of its own, is ready, without holding Python's global lock.

    Whatever is asked of Dr.Jit waits for that thread, but most functions hold the lock meanwhile. The thread needs it
    to print that an LLVM is missing or too old, so both would wait forever where the message comes late (a library on
    a cold disk; Dr.Jit's issue 524). `drjit.sync_thread` gives the lock away.
    """
    import drjit as dr

    dr.sync_thread()


def _setting() -> str:
    """What to do with the variable, the end of a sentence."""
    try:
        return f"set {VARIABLE}={find(variables={}).path}"
    except ImportError:
        return f"run `pip install {PACKAGE}`, or set {VARIABLE} to the file of an LLVM >= {MIN_MAJOR},"
