"""The choice of an LLVM library. Whatever concerns Dr.Jit's own start runs in a process of its own."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rimlight import _llvm

GOOD = _llvm.active()
SYSTEM = [file for file in _llvm.system_libraries() if os.path.isfile(file)]
OLD = [file for file in SYSTEM if (_llvm.version_in_name(file) or 99) < _llvm.MIN_MAJOR]

needs_old = pytest.mark.skipif(not OLD, reason="needs an LLVM older than 17 on the system")
needs_good = pytest.mark.skipif(GOOD is None, reason="needs an LLVM of 17 or newer")


def run(code: str, **variables: str | None) -> subprocess.CompletedProcess[str]:
    """Run Python code with environment variables added, or removed (None)."""
    environment = {**os.environ, _llvm.VARIABLE: None, **variables}
    return subprocess.run(
        [sys.executable, "-c", code],
        env={name: value for name, value in environment.items() if value is not None},
        capture_output=True,
        text=True,
        timeout=120,
    )


# Aborts the process under LLVM 15 and 16 on processors with AVX-512
KERNEL = """
import drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
assert dr.allclose(dr.minimum(dr.arange(mi.Float, 3), dr.opaque(mi.Float, 1.5)), [0, 1, 1.5])
print(dr.detail.llvm_version()[0])
"""


def assert_runs(process: subprocess.CompletedProcess[str]) -> None:
    assert process.returncode == 0, process.stderr
    assert int(process.stdout.split()[-1]) >= _llvm.MIN_MAJOR


# ------------------------------------------------------------------ names and files


@pytest.mark.parametrize(
    ("name", "major"),
    [
        ("libLLVM-14.so.1", 14),
        ("libLLVM-14.0.6.so", 14),
        ("libLLVM.so.19.1", 19),
        ("libLLVM-16.dylib", 16),
        ("libLLVM.so", None),
        ("LLVM-C.dll", None),
    ],
)
def test_version_in_name(name: str, major: int | None) -> None:
    assert _llvm.version_in_name(f"/nowhere/{name}") == major


def test_version_in_name_follows_links(tmp_path: Path) -> None:
    (tmp_path / "libLLVM.so.19.1").touch()
    (tmp_path / "libLLVM.so").symlink_to("libLLVM.so.19.1")
    assert _llvm.version_in_name(str(tmp_path / "libLLVM.so")) == 19


def test_newest_first(tmp_path: Path) -> None:
    names = ["libLLVM.so.18.1", "libLLVM-9.so.1", "libLLVM.so.20.1"]
    for name in names:
        (tmp_path / name).touch()
    files = _llvm.newest_first(str(tmp_path / name) for name in names)
    assert [Path(file).name for file in files] == ["libLLVM.so.20.1", "libLLVM.so.18.1", "libLLVM-9.so.1"]


def test_inspect_refuses(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="does not exist"):
        _llvm.inspect(str(tmp_path / "libLLVM.so"))
    (tmp_path / "libLLVM.so").write_text("no library")
    with pytest.raises(ValueError, match="cannot be loaded"):
        _llvm.inspect(str(tmp_path / "libLLVM.so"))
    (tmp_path / "libLLVM-16.so").touch()
    with pytest.raises(ValueError, match=r"is LLVM 16, .* needs LLVM >= 17"):
        _llvm.inspect(str(tmp_path / "libLLVM-16.so"))


@needs_old
def test_inspect_refuses_an_old_library_under_a_neutral_name(tmp_path: Path) -> None:
    copy = tmp_path / "libsomething.so"
    shutil.copyfile(OLD[0], copy)  # a link would be followed to the telling name
    code = f"from rimlight import _llvm\ntry: _llvm.inspect({str(copy)!r})\nexcept ValueError as e: print(e)"
    assert "older than LLVM 16" in run(code).stdout


@needs_good
def test_inspect_loads_an_unfinished_installation(tmp_path: Path) -> None:
    """The package's library, without the links that its first start adds."""
    library = Path(GOOD.path)
    companions = sorted(library.parent.glob("*-linux-*/lib*.so.1.0"))
    if not companions:
        pytest.skip("needs the LLVM of karellen-llvm-core")
    shutil.copy(library, tmp_path)
    folder = tmp_path / companions[0].parent.name
    folder.mkdir()
    for file in companions:
        shutil.copy(file, folder)
    process = run(
        "from rimlight import _llvm; print(_llvm.find().path)" + KERNEL,
        **{_llvm.VARIABLE: str(tmp_path / library.name)},
    )
    assert_runs(process)
    assert process.stdout.split()[0] == str(tmp_path / library.name)
    assert process.stderr == ""


# ------------------------------------------------------------------ order of the search


@needs_good
def test_order() -> None:
    def choose(named: str, environment: list[str], system: list[str]) -> str:
        variables = {_llvm.VARIABLE: named}
        return _llvm.find(variables=variables, environment=lambda: environment, system=lambda: system).origin

    good = GOOD.path
    assert choose(good, [good], [good]) == _llvm.ORIGIN_VARIABLE
    assert choose("", [good], [good]) == _llvm.ORIGIN_ENVIRONMENT
    assert choose(_llvm.DISABLED, [], ["/nowhere/libLLVM.so", good]) == _llvm.ORIGIN_SYSTEM


@needs_good
def test_a_bad_variable_is_reported_and_replaced() -> None:
    variables = {_llvm.VARIABLE: "/nowhere/libLLVM.so"}
    with pytest.warns(RuntimeWarning, match=r"/nowhere/libLLVM.so does not exist. Using LLVM "):
        llvm = _llvm.find(variables=variables, environment=lambda: [GOOD.path])
    assert llvm.path == GOOD.path
    assert variables == {_llvm.VARIABLE: "/nowhere/libLLVM.so"}


def test_failure_names_the_reasons_and_the_remedy() -> None:
    with pytest.raises(ImportError) as failure:
        _llvm.find(
            variables={_llvm.VARIABLE: "/nowhere/a.so"}, environment=lambda: [], system=lambda: ["/nowhere/b.so"]
        )
    for text in ("pip install karellen-llvm-core", _llvm.VARIABLE, "/nowhere/a.so does not", "/nowhere/b.so does not"):
        assert text in str(failure.value)


def test_a_missing_libatomic_is_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    """The LLVM of the environment is there, in a container that lacks what it needs."""

    def inspect(path: str) -> int:
        raise ValueError("cannot be loaded (libatomic.so.1: cannot open shared object file)")

    monkeypatch.setattr(_llvm, "inspect", inspect)
    with pytest.raises(ImportError, match="apt install libatomic1") as failure:
        _llvm.find(variables={}, environment=lambda: ["/env/libLLVM.so"], system=lambda: [])
    assert "pip install" not in str(failure.value)


def nothing_usable(monkeypatch: pytest.MonkeyPatch, backend: str | None) -> None:
    monkeypatch.setenv(_llvm.VARIABLE, "")
    monkeypatch.setattr(_llvm, "find", lambda: (_ for _ in ()).throw(ImportError("nothing; the remedy")))
    monkeypatch.setattr(_llvm, "other_backend", lambda: backend)


def test_nothing_usable_fails_without_another_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing_usable(monkeypatch, None)
    with pytest.raises(ImportError, match="the remedy"):
        _llvm._choose()


def test_nothing_usable_disables_llvm_with_another_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing_usable(monkeypatch, "CUDA")
    with pytest.warns(RuntimeWarning, match="(?s)the remedy.*Only the CUDA backend"):
        assert _llvm._choose() is None
    assert os.environ[_llvm.VARIABLE] == _llvm.DISABLED
    assert _llvm._choose() is None  # a child process inherits the variable, and is silent


# ------------------------------------------------------------------ with Dr.Jit, each in a process of its own


@needs_good
def test_chosen_without_a_variable() -> None:
    process = run("import rimlight" + KERNEL)
    assert_runs(process)
    assert process.stderr == ""


@needs_good
def test_missing_file_is_replaced() -> None:
    process = run("import rimlight" + KERNEL, **{_llvm.VARIABLE: "/nowhere/libLLVM.so"})
    assert_runs(process)
    assert "DRJIT_LIBLLVM_PATH is ignored: /nowhere/libLLVM.so does not exist" in process.stderr


@needs_good
@needs_old
def test_old_library_is_replaced() -> None:
    process = run("import rimlight" + KERNEL, **{_llvm.VARIABLE: OLD[0]})
    assert_runs(process)
    assert "is ignored" in process.stderr


def assert_explains(process: subprocess.CompletedProcess[str]) -> str:
    """Dr.Jit has made its own choice, a bad one. The message says what helps; returns the library that it names."""
    assert process.returncode == 1
    assert re.search(r"RuntimeError: rimlight: Dr.Jit (already uses LLVM 1[56]|found no LLVM)", process.stderr)
    assert "Import `rimlight` before `mitsuba` and `drjit`" in process.stderr
    return re.search(rf"set {_llvm.VARIABLE}=(.+) before Python starts", process.stderr)[1]


@needs_good
@pytest.mark.skipif(_llvm.other_backend() is not None, reason="another backend takes over")
@pytest.mark.parametrize("first", ["mitsuba as mi", "drjit", "drjit.llvm"])
def test_rimlight_imported_after(first: str) -> None:
    code = f"import {first}\nimport rimlight" + KERNEL
    process = run(code)
    if process.returncode:
        process = run(code, **{_llvm.VARIABLE: assert_explains(process)})
    assert_runs(process)


@needs_good
@needs_old
@pytest.mark.skipif(_llvm.other_backend() is not None, reason="another backend takes over")
def test_rimlight_imported_after_drjit_found_an_old_library() -> None:
    """Dr.Jit refuses LLVM 14 by itself, and accepts 15 and 16."""
    for file in OLD:
        assert_explains(run("import drjit\nimport rimlight" + KERNEL, **{_llvm.VARIABLE: file}))


@needs_good
@pytest.mark.skipif(_llvm.other_backend() is not None, reason="another backend takes over")
def test_rimlight_imported_after_drjit_found_nothing() -> None:
    process = run("import drjit\nimport rimlight", **{_llvm.VARIABLE: "/nowhere/libLLVM.so"})
    assert process.returncode == 1
    assert "RuntimeError: rimlight: Dr.Jit found no LLVM" in process.stderr
    assert "Import `rimlight` before `mitsuba`" in process.stderr


SLOW_DISK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <string.h>
#include <unistd.h>
void *dlopen(const char *file, int mode) {
    void *(*original)(const char *, int) = dlsym(RTLD_NEXT, "dlopen");
    void *library = original(file, mode);
    if (file && strstr(file, "LLVM"))
        usleep(500000);  // more than Rimlight needs to ask
    return library;
}
"""


@needs_good
@pytest.mark.skipif(sys.platform != "linux" or not shutil.which("cc"), reason="needs Linux and a C compiler")
@pytest.mark.skipif(_llvm.other_backend() is not None, reason="another backend takes over")
def test_rimlight_imported_while_drjit_still_starts(tmp_path: Path) -> None:
    """Dr.Jit complains about its library only when Rimlight waits for it already."""
    preloaded = tmp_path / "slow_disk.so"
    (tmp_path / "slow_disk.c").write_text(SLOW_DISK)
    subprocess.run(
        ["cc", "-shared", "-fPIC", "-o", preloaded, tmp_path / "slow_disk.c", "-ldl"], check=True, timeout=60
    )
    code = "import drjit\nimport rimlight"
    process = run(code, **{_llvm.VARIABLE: "/nowhere/libLLVM.so", "LD_PRELOAD": str(preloaded)})
    assert_explains(process)


@needs_good
def test_rimlight_imported_while_a_good_library_is_in_use() -> None:
    code = "import mitsuba as mi\nmi.set_variant('llvm_ad_rgb')\nx = mi.Float(1, 2)\nimport rimlight\nprint(x)"
    assert_runs(run(code + KERNEL, **{_llvm.VARIABLE: GOOD.path}))


@pytest.mark.parametrize("use", ["import drjit.llvm; x = drjit.llvm.Float(1, 2)", "mi.set_variant('llvm_ad_rgb')"])
def test_rimlight_imported_while_an_old_library_is_in_use(use: str) -> None:
    # 15 and 16 only: with an older one Dr.Jit switches the backend off by itself
    usable = [file for file in OLD if _llvm.version_in_name(file) in (15, 16)]
    if not usable:
        pytest.skip("needs LLVM 15 or 16 on the system")
    process = run(f"import mitsuba as mi\n{use}\nimport rimlight", **{_llvm.VARIABLE: usable[0]})
    assert process.returncode == 1
    assert "RuntimeError: rimlight: Dr.Jit already uses LLVM 1" in process.stderr
    assert "Import `rimlight` before" in process.stderr


def test_disabled_backend_is_off_in_drjit() -> None:
    code = "import drjit as dr; print(dr.has_backend(dr.JitBackend.LLVM))"
    assert run(code, **{_llvm.VARIABLE: _llvm.DISABLED}).stdout.split() == ["0"]


@needs_good
def test_import_is_quick() -> None:
    """The choice must stay a small part of the second that importing Mitsuba takes."""
    code = "import rimlight._llvm as m, time; t = time.perf_counter(); m.find(); print(time.perf_counter() - t)"
    assert min(float(run(code).stdout) for _ in range(3)) < 0.05
