"""Registration of plugins with Mitsuba, per variant, and the layering of the packages."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import mitsuba as mi
import pytest

import rimlight
from rimlight import _registration

BASE = """
import mitsuba as mi

class Base(mi.SamplingIntegrator):
    pass
"""

PLUGIN = """
import mitsuba as mi

from rimlight.integrators._throwaway_base import Base

SCALE = mi.Float(0.5)


class ThrowawayIntegrator(Base):
    def __init__(self, props):
        super().__init__(props)
        self.value = props.get("value", 1.0)

    def sample(self, scene, sampler, ray, medium, active):
        return mi.Color3f(SCALE * self.value) if mi.is_rgb else mi.Spectrum(SCALE * self.value), active, []

    def aov_names(self):
        return []


mi.register_integrator("throwaway", ThrowawayIntegrator)
"""


@pytest.fixture
def throwaway(tmp_path: Path) -> Iterator[None]:
    """Adds a plugin file, and a helper module that it imports, to `rimlight.integrators`."""
    (tmp_path / "_throwaway_base.py").write_text(BASE)
    (tmp_path / "throwaway.py").write_text(PLUGIN)
    package = importlib.import_module("rimlight.integrators")
    package.__path__.append(str(tmp_path))
    importlib.invalidate_caches()
    _registration._modules.clear()
    variant = mi.variant()
    yield
    mi.set_variant(variant)
    package.__path__.remove(str(tmp_path))
    # Afresh: Mitsuba knows the latest classes, and imports must find the modules of these.
    _registration._modules.clear()
    rimlight.register()


def value_of_a_pixel() -> float:
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "throwaway", "value": 4.0},
            "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 2, "height": 2, "rfilter": BOX}},
        }
    )
    return mi.render(scene, spp=1).numpy()[0, 0, 0]


BOX = {"type": "box"}


def current() -> type:
    return sys.modules["rimlight.integrators.throwaway"].ThrowawayIntegrator


def test_current_variant(throwaway: None) -> None:
    rimlight.register()
    assert type(mi.load_dict({"type": "throwaway"})) is current()
    assert value_of_a_pixel() == pytest.approx(2.0)


def test_registered_once_per_variant(throwaway: None) -> None:
    rimlight.register()
    first = current()
    rimlight.register()
    importlib.reload(rimlight)  # what Mitsuba >= 3.10 does
    assert current() is first
    assert set(_registration.plugin_modules(mi.variant())) >= {
        "rimlight.integrators.throwaway",
        "rimlight.integrators._throwaway_base",
    }


def test_switching_variants(throwaway: None) -> None:
    rimlight.register()
    rgb, object_rgb = current(), mi.load_dict({"type": "throwaway"})

    mi.set_variant("llvm_ad_spectral")
    spectral = current()
    assert spectral is not rgb
    assert issubclass(spectral, mi.SamplingIntegrator) and not issubclass(rgb, mi.SamplingIntegrator)
    assert type(mi.load_dict({"type": "throwaway"})) is spectral

    mi.set_variant("llvm_ad_rgb")
    assert current() is rgb
    assert rimlight.integrators.throwaway is sys.modules["rimlight.integrators.throwaway"]
    assert type(mi.load_dict({"type": "throwaway"})) is rgb
    assert isinstance(object_rgb, mi.SamplingIntegrator)
    assert value_of_a_pixel() == pytest.approx(2.0)


def test_integrators_after_switching_variants() -> None:
    """Mitsuba's Python base classes are executed again for each variant, and must be found anew."""
    mi.set_variant("llvm_ad_spectral")
    try:
        for kind in ("direct_edge", "prb_edge"):
            assert isinstance(mi.load_dict({"type": kind}), mi.Integrator)
    finally:
        mi.set_variant("llvm_ad_rgb")
    assert isinstance(mi.load_dict({"type": "direct_edge"}), mi.Integrator)


def test_scalar_variant_is_left_alone(throwaway: None) -> None:
    rimlight.register()
    rgb = current()
    mi.set_variant("scalar_rgb")
    rimlight.register()
    assert _registration.plugin_modules("scalar_rgb") == {}
    mi.set_variant("llvm_ad_rgb")
    assert current() is rgb


def test_a_broken_plugin_is_reported_every_time(throwaway: None) -> None:
    folder = Path(importlib.import_module("rimlight.integrators").__path__[-1])
    (folder / "unfinished.py").write_text("raise ValueError('unfinished')")
    importlib.invalidate_caches()
    for _ in range(2):
        with pytest.raises(ValueError, match="unfinished"):
            rimlight.register()
    assert "rimlight.integrators.throwaway" not in sys.modules


def run(code: str) -> str:
    process = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=120)
    assert process.returncode == 0, process.stderr
    assert process.stderr == ""  # no leak reports of nanobind at exit, either
    return process.stdout.strip()


def test_import_needs_no_variant_and_sets_none() -> None:
    assert run("import rimlight, mitsuba as mi; print(mi.variant(), rimlight.__version__)") == "None 0.1.0"


@pytest.mark.parametrize("order", ["import rimlight; mi.set_variant(v)", "mi.set_variant(v); import rimlight"])
def test_variant_before_and_after_the_import(order: str) -> None:
    # This process has named a good library in DRJIT_LIBLLVM_PATH, and the child inherits it
    code = f"import mitsuba as mi; v = 'llvm_ad_rgb'; {order}; import rimlight._registration as r"
    assert run(code + "; print(list(r._modules))") == "['llvm_ad_rgb']"


# ------------------------------------------------------------------ layering


def imports(file: Path) -> set[str]:
    """Full names of everything that a file of ours imports."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level <= 1, f"{file}: relative import from outside the package"
            if node.level == 0:
                names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.py"))


def test_edge_sampling_knows_no_plugin(root: Path) -> None:
    for file in files(root / "edge_sampling"):
        outside = {name for name in imports(file) if name.split(".")[0] == "rimlight"}
        # The guard against the garbage collector is everybody's, and knows nothing of Rimlight.
        allowed = ("rimlight.edge_sampling", "rimlight._collection")
        assert all(name.startswith(allowed) for name in outside), f"{file} imports {outside}"


def test_plugins_do_not_know_the_fits(root: Path) -> None:
    for file in files(root / "plugins"):
        if "cli" not in file.parts:  # the command line stands above all
            assert not [name for name in imports(file) if name.startswith("rimlight.inverse")], file


def test_inverse_uses_no_plugin_directly(root: Path) -> None:
    for file in files(root / "inverse"):
        direct = [name for name in imports(file) if name.startswith("rimlight.integrators")]
        assert not direct, f"{file} imports {direct}; use mi.load_dict"


@pytest.mark.parametrize("folder", ["plugins", "edge_sampling", "inverse", "scenes"])
def test_packages_are_imported_by_their_name(root: Path, folder: str) -> None:
    for file in [*files(root / folder), *files(root / "tests")]:
        tops = {name.split(".")[0] for name in imports(file)}
        assert not tops & {"plugins", "edge_sampling", "inverse"}, file


#: What each room may import: itself, and those before it.
ROOMS = (
    "rimlight.edge_sampling.refusals",
    "rimlight.edge_sampling.rays",
    "rimlight.edge_sampling.geometry",
    "rimlight.edge_sampling.projection",
    "rimlight.edge_sampling.lights",
    "rimlight.edge_sampling.smooth_lamps",
    "rimlight.edge_sampling.parametrisation",
    "rimlight.edge_sampling.first_points",
    "rimlight.edge_sampling.fine_textures",
    "rimlight.edge_sampling.emitter_table",
    "rimlight.edge_sampling.close_lamps",
    "rimlight.edge_sampling.divided_light",
    "rimlight.edge_sampling.choice",
    "rimlight.edge_sampling.boundaries",
    "rimlight.transport",
    "rimlight.terms",
    "rimlight.integrators",
)


def room(name: str) -> int | None:
    """Number of the room that a module is in, None if it is in none."""
    return next((i for i, r in enumerate(ROOMS) if f"{name}.".startswith(f"{r}.")), None)


@pytest.mark.parametrize("folder", ["edge_sampling", "plugins"])
def test_imports_run_one_way(root: Path, folder: str) -> None:
    package = "rimlight.edge_sampling" if folder == "edge_sampling" else "rimlight"
    seen = 0
    for file in files(root / folder):
        module = ".".join([package, *file.relative_to(root / folder).with_suffix("").parts])
        own = room(module)
        if own is None:
            continue
        seen += 1
        later = {n for n in imports(file) if room(n) is not None and room(n) > own}
        assert not later, f"{file} imports {later}"
        # All of `edge_sampling` together is for those above.
        whole = {n for n in imports(file) if n.startswith("rimlight.edge_sampling.") and room(n) is None}
        assert folder != "edge_sampling" or not whole, f"{file} imports {whole}"
    assert seen > 10
