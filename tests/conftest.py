"""Fixtures shared by all tests. Importing rimlight first chooses the LLVM library before Dr.Jit is imported."""

# isort: off
import rimlight  # noqa: F401
import mitsuba as mi
import drjit as dr
# isort: on

import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import gallery
import pages
import pytest
import tiers

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared" / "data"

#: `RIMLIGHT_TEST_VARIANT=cuda_ad_rgb make test` runs the tests on a GPU (docs/gpu.md).
VARIANT = os.environ.get("RIMLIGHT_TEST_VARIANT", "llvm_ad_rgb")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    unknown = tiers.mark(items, pytest.mark.fast, pytest.mark.slow)
    if unknown and not any("::" in argument for argument in config.args):
        raise pytest.UsageError(f"tests/tiers.py lists what is no test: {', '.join(sorted(unknown))}")


def pytest_configure(config: pytest.Config) -> None:
    if gallery.wanted() and not hasattr(config, "workerinput"):
        gallery.clear()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say what a row of dots does not: which tests could not run here, and where the pictures are."""
    skipped = [r for r in terminalreporter.stats.get("skipped", []) if pages.NO_BROWSER in str(r.longrepr)]
    if skipped:
        terminalreporter.write_line(
            f"NOT RUN: {len(skipped)} tests of pages in a browser, since there is no Chromium or relative of it here.",
            yellow=True,
        )
    if gallery.wanted() and (path := gallery.write()):
        terminalreporter.write_line(f"All derivatives beside their references, the worst first: {path}")


@pytest.fixture(scope="session", autouse=True)
def variant() -> Iterator[str]:
    """The variant of all tests. A test that changes it sets it back."""
    mi.set_variant(VARIANT)
    yield VARIANT


#: Kernels that had been launched when memory was last freed.
launched = 0


@pytest.fixture(autouse=True)
def free_memory() -> Iterator[None]:
    """Free what a test left behind. Kernels stay: compiling them again is most of a short test's time.

    The collector looks at what the test has made only: at all else, which takes 0.07 s each time, once for each file.
    Not after a test that launched no kernel, which left no scene that was used.
    """
    global launched
    gc.freeze()
    yield
    if mi.variant() != VARIANT:
        mi.set_variant(VARIANT)
    launches, _, _ = dr.detail.launch_stats()
    if launches != launched:
        launched = launches
        gc.collect()
        dr.flush_malloc_cache()
    gc.unfreeze()


@pytest.fixture(autouse=True, scope="module")
def free_memory_of_module() -> Iterator[None]:
    gc.collect()
    yield


@pytest.fixture
def no_derivative_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fits do not render one at their end: it takes a second or two to compile, and many tests do not look at it."""
    monkeypatch.setattr("rimlight.inverse.renderer.Renderer.derivative", lambda *_: None)


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
