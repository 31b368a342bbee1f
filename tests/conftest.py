"""Fixtures shared by all tests. Importing rimlight first chooses the LLVM library before Dr.Jit is imported."""

# isort: off
import rimlight  # noqa: F401
import mitsuba as mi
import drjit as dr
# isort: on

import gc
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared" / "data"


@pytest.fixture(scope="session", autouse=True)
def variant() -> Iterator[str]:
    """The variant of all tests. A test that changes it sets it back."""
    mi.set_variant("llvm_ad_rgb")
    yield "llvm_ad_rgb"


@pytest.fixture(autouse=True)
def free_memory() -> Iterator[None]:
    """Free what a test left behind. Kernels stay: compiling them again is most of a short test's time."""
    yield
    gc.collect()
    dr.flush_malloc_cache()


@pytest.fixture(scope="session")
def shared() -> Callable[[str], Path]:
    """Path of a file in the shared data, which are not part of the repository. Skips the test when it is missing."""

    def path(name: str) -> Path:
        file = SHARED / name
        if not file.exists():
            pytest.skip(f"needs the data file {file}")
        return file

    return path


@pytest.fixture(scope="session")
def root() -> Path:
    """Folder of the repository."""
    return ROOT
