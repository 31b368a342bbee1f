"""Build the packages, and test them as a user gets them:  python tests/distribution.py [PYTHON ...]   (`make dist`)

Writes a wheel and an archive of the sources to dist/, from the files that git tracks. Both are built twice, and must be
the same byte by byte. Then the wheel alone is installed in an empty environment of each PYTHON, where the first
Python block of the README and the fast tests must pass. The tests are those of the archive: nothing of this checkout is
used.
"""

from __future__ import annotations

import gzip
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

#: What the tests need, as the extra `test` lists it.
EXTRAS = "test,smoothing"


def run(*command: str | Path, cwd: Path, env: dict[str, str] | None = None) -> str:
    """Run a command and return its standard output. Raises CalledProcessError after printing what it wrote."""
    done = subprocess.run([*map(str, command)], cwd=cwd, env=env, capture_output=True, text=True)
    if done.returncode:
        print(done.stdout[-8000:], done.stderr[-8000:], sep="\n", file=sys.stderr)
        done.check_returncode()
    return done.stdout


def build(out: Path) -> tuple[Path, Path]:
    """Build the archive of the sources, and the wheel from it, in a copy of the tracked files. Returns both."""
    epoch = run("git", "log", "-1", "--format=%ct", cwd=ROOT).strip()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "rimlight"
        for name in run("git", "ls-files", cwd=ROOT).splitlines():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, copy / name)
        run(sys.executable, "-m", "build", "--outdir", out, cwd=copy, env={**os.environ, "SOURCE_DATE_EPOCH": epoch})
    (wheel,), (archive,) = out.glob("*.whl"), out.glob("*.tar.gz")
    normalise(archive, int(epoch))
    return wheel, archive


def normalise(archive: Path, epoch: int) -> None:
    """Sort the entries of an archive, and give all of them one time and no owner: setuptools does not."""
    with tarfile.open(archive) as old:
        entries = [(e, old.extractfile(e).read() if e.isfile() else b"") for e in old.getmembers()]
    with (
        tempfile.TemporaryFile() as plain,
        open(archive, "wb") as raw,
        gzip.GzipFile("", "wb", 9, raw, mtime=epoch) as packed,
    ):
        with tarfile.open(fileobj=plain, mode="w", format=tarfile.PAX_FORMAT) as new:
            for entry, content in sorted(entries, key=lambda pair: pair[0].name):
                made = tarfile.TarInfo(entry.name)
                made.type, made.size, made.mtime = entry.type, len(content), epoch
                made.mode = 0o755 if entry.isdir() or entry.mode & 0o100 else 0o644
                with tempfile.TemporaryFile() as data:
                    data.write(content)
                    data.seek(0)
                    new.addfile(made, data)
        plain.seek(0)
        shutil.copyfileobj(plain, packed)


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def ten_lines(readme: str) -> str:
    """The first block of Python in the README."""
    found = re.search(r"^```python\n(.*?)^```$", readme, re.DOTALL | re.MULTILINE)
    assert found is not None
    return found[1]


def check(python: str, wheel: Path, archive: Path) -> None:
    """Install the wheel in an empty environment of a Python, and use it.

    Raises
    ------
    CalledProcessError : something fails. What it wrote was printed.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        run(python, "-m", "venv", folder / "env", cwd=folder)
        own = folder / "env" / "bin" / "python"
        version = run(own, "--version", cwd=folder).strip()
        run(own, "-m", "pip", "install", "--quiet", wheel, cwd=folder)
        with tarfile.open(archive) as sources:
            sources.extractall(folder, filter="data")
        (tree,) = folder.glob("rimlight-*")

        empty = folder / "empty"
        empty.mkdir()
        readme = (tree / "README.md").read_text("utf-8")
        printed = run(own, "-c", ten_lines(readme), cwd=empty)
        assert "nan" not in printed and printed.strip(), f"the ten lines printed {printed!r}"
        assert (empty / "cube.png").stat().st_size, "the ten lines wrote no picture"
        place = run(own, "-c", "import rimlight; print(rimlight.__file__)", cwd=empty)
        assert str(folder / "env") in place, f"rimlight was imported from {place}"
        run(folder / "env" / "bin" / "rimlight", "sys-info", cwd=empty)
        print(f"{version}: the wheel works, the ten lines write a picture and print a gradient", flush=True)

        run(own, "-m", "pip", "install", "--quiet", f"{wheel}[{EXTRAS}]", cwd=folder)
        # Neither the tests' own folder nor the checkout may be found as the package: it has another name there
        tests = run(own, "-m", "pytest", "-q", "-n", "2", "--dist", "worksteal", "-m", "fast", cwd=tree)
        print(f"{version}: {tests.strip().splitlines()[-1]}", flush=True)


def main(pythons: list[str]) -> None:
    dist = ROOT / "dist"
    shutil.rmtree(dist, ignore_errors=True)
    files = build(dist)
    with tempfile.TemporaryDirectory() as again:
        for first, second in zip(files, build(Path(again)), strict=True):
            if digest(first) != digest(second):
                raise SystemExit(f"{first.name} is another file when it is built again")
            print(f"{digest(first)}  {first.name}", flush=True)
    for python in pythons:
        check(python, *files)


if __name__ == "__main__":
    main(sys.argv[1:])
