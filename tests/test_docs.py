"""The documentation is true: its Python runs, its scenes load, its command lines parse, its links lead somewhere."""

from __future__ import annotations

import importlib.util
import inspect
import json
import os
import re
import shlex
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from rimlight import merl_tables, scenes
from rimlight._registration import plugin_modules

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").rglob("*.md") if "_build" not in p.parts)]

BLOCK = re.compile(
    r"(?P<skip><!-- skip: [^>]+-->\s*)?^(?P<indent> *)```(?P<language>\w+|\{code-cell\})\n(?::tags: [^\n]*\n)?"
    r"(?P<code>.*?)^ *```$",
    re.DOTALL | re.MULTILINE,
)

#: A part of a notebook. A page with such parts has no other Python.
CELL = "{code-cell}"

#: What precedes the blocks of a page: warnings are errors here, too.
PROLOGUE = "import warnings\nwarnings.simplefilter('error')\n"


@dataclass(frozen=True)
class Block:
    """A fenced block of code.

    line : of its first line of code, from 1.
    """

    language: str
    code: str
    line: int


def blocks(text: str) -> list[Block]:
    """The blocks of a page that are not preceded by ``<!-- skip: reason -->``."""
    return [
        Block(m["language"], textwrap.dedent(m["code"]), text.count("\n", 0, m.start("code")) + 1)
        for m in BLOCK.finditer(text)
        if not m["skip"]
    ]


def program(page: Path, found: list[Block]) -> str:
    """The Python and XML blocks of a page as one program, in one namespace. Errors name the lines of the page."""
    parts = [PROLOGUE]
    for block in found:
        if block.language in ("python", CELL):
            code = "\n" * (block.line - 1) + block.code
            parts.append(f"exec(compile({code!r}, {str(page)!r}, 'exec'))")
        elif block.language == "xml":
            parts.append("import rimlight, mitsuba\nmitsuba.set_variant('llvm_ad_rgb')")
            parts.append(f"mitsuba.load_string({block.code!r})")
    return "\n".join(parts)


def commands(text: str) -> list[str]:
    """Command lines of `rimlight` in the blocks for the shell."""
    lines = [line.strip() for block in blocks(text) if block.language == "sh" for line in block.code.splitlines()]
    return [line for line in lines if line.startswith("rimlight ")]


def read(page: Path) -> str:
    return page.read_text(encoding="utf-8")


PROGRAMS = [p for p in PAGES if any(b.language in ("python", CELL, "xml") for b in blocks(read(p)))]
COMMANDS = sorted({line for page in PAGES for line in commands(read(page))})


@pytest.mark.parametrize("page", PROGRAMS, ids=lambda p: p.name)
def test_snippets_run(page, tmp_path):
    script = tmp_path / "snippets.py"
    script.write_text(program(page, blocks(read(page))), encoding="utf-8")
    # IPython warns, if another environment than that of this Python is active in the shell.
    env = {k: v for k, v in os.environ.items() if k != "VIRTUAL_ENV"}
    command = [sys.executable, script.name]
    result = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=240)
    assert result.returncode == 0, result.stderr[-3000:]


@pytest.fixture(scope="module")
def example_files(variant, tmp_path_factory) -> None:
    """Files that the pages name, in a folder that Mitsuba searches."""
    folder = tmp_path_factory.mktemp("examples")
    merl_tables.write_merl(folder / "gray-plastic.binary", np.full(merl_tables.SHAPE, 0.1))
    mi.file_resolver().prepend(str(folder))


@pytest.mark.parametrize("name", [p.stem for p in sorted((ROOT / "docs" / "plugins").glob("*.rst"))])
def test_tabs_of_manual_pages_load(example_files, name):
    """The XML and the Python of a plugin's page make objects of the same type."""
    (module,) = (m for k, m in plugin_modules(mi.variant()).items() if k.rpartition(".")[2] == name)
    (page,) = (text for c in vars(module).values() if inspect.isclass(c) and "code-tab::" in (text := c.__doc__ or ""))
    page = inspect.cleandoc(page)
    tabs = dict(re.findall(r"\.\. code-tab:: (\w+)\n\n(.*?)(?=\n *\.\. code-tab|\Z)", page, re.DOTALL))
    python = mi.load_dict(eval(f"{{{textwrap.dedent(tabs['python'])}}}", {"mi": mi}))
    xml = mi.load_string(tabs["xml"].strip().replace(">", ' version="3.0.0">', 1))
    assert type(python) is type(xml)


@pytest.mark.parametrize("line", COMMANDS)
def test_command_lines_parse(line):
    """Options and their values are known, and files that are named exist. Nothing is run."""
    import tyro

    from rimlight.cli._commands import commands as known

    arguments = [str(ROOT / "scenes/fits/fig6a.toml") if a.endswith(".toml") else a for a in shlex.split(line)[1:]]
    command = tyro.extras.subcommand_cli_from_dict(known(arguments), args=arguments)
    scene = getattr(command, "scene", None)
    assert scene is None or (ROOT / scene).is_file()


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page):
    """Relative links and pictures of Markdown, included files, and referenced pages."""
    text = re.sub(r"```(?:python|xml|sh).*?```", "", read(page), flags=re.DOTALL)
    targets = re.findall(r"\]\((?!https?:|#)([^)#\s]+)", text)
    targets += re.findall(r"^```\{(?:include|image)\} (\S+)", text, re.MULTILINE)
    missing = [target for target in targets if not (page.parent / target).exists()]
    documents = re.findall(r"\{doc\}`(?:[^`<]*<)?([\w/.]+)>?`", text)
    missing += [d for d in documents if not any((page.parent / f"{d}.{end}").exists() for end in ("md", "rst"))]
    assert not missing


def test_notebooks_open_with_their_picture_and_say_their_time():
    notebooks = sorted((ROOT / "docs" / "notebooks").glob("*.md"))
    assert len(notebooks) >= 3
    for page in notebooks:
        start, _, _ = read(page).partition("```{code-cell}")
        assert "```{glue:figure} result\n:alt: " in start and "{glue:text}`seconds:.0f` seconds" in start, page


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_pictures_have_alternatives(page):
    """For those who cannot see them: a text in the brackets, or the option `alt`."""
    text = re.sub(r"```(?:python|xml|sh).*?```", "", read(page), flags=re.DOTALL)
    assert not [target for alt, target in re.findall(r"!\[([^\]]*)\]\(([^)]+)\)", text) if not alt.strip()]
    options = re.findall(r"^```\{(?:image|figure|glue:figure)\}[^\n]*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    assert all(re.search(r"^:alt: \S", block, re.MULTILINE) for block in options)


def test_there_is_something_to_test():
    assert {"README.md", "getting_started.md", "extending.md"} <= {p.name for p in PROGRAMS}
    assert any(b.language == "xml" for b in blocks(read(ROOT / "README.md")))
    assert len(COMMANDS) >= 5


def test_blocks_are_found():
    text = (
        "```python\na = 1\n```\n\n"
        "1. item:\n\n   ```sh\n   rimlight demo\n   ```\n\n"
        "<!-- skip: takes an hour -->\n```python\nraise SystemExit(1)\n```\n"
        "```{eval-rst}\nno code\n```\n"
    )
    assert blocks(text) == [Block("python", "a = 1\n", 2), Block("sh", "rimlight demo\n", 8)]
    assert blocks("```{code-cell}\n:tags: [remove-output]\na = 1\n```\n") == [Block(CELL, "a = 1\n", 3)]
    assert commands(text) == ["rimlight demo"]


def test_a_failing_snippet_is_noticed(tmp_path):
    page = tmp_path / "page.md"
    source = program(page, blocks("text\n\n```python\na = 1\n```\n```python\nassert a == 2\n```\n"))
    result = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True)
    assert result.returncode != 0
    assert f'{page}", line 7' in result.stderr


def test_every_public_function_has_an_example():
    """All that the API page lists is used by Python that the tests run, or linked to beside such code."""
    examples = from_file(ROOT / "docs" / "_ext" / "examples.py")
    module, listed = "", []
    for kind, name in re.findall(r"^\.\. (\w+):: ([\w.]+)$", read(ROOT / "docs" / "api.md"), re.MULTILINE):
        if kind == "currentmodule":
            module = name
        elif kind in ("autofunction", "autoclass", "automethod"):
            listed.append(name if name.startswith("rimlight.") else f"{module}.{name}")
    assert len(listed) >= 90
    assert not [name for name in listed if not examples.examples(name)]


def test_uses_are_read_off_code():
    used = from_file(ROOT / "docs" / "_ext" / "examples.py").used
    assert used("import rimlight\nrimlight.plan(1)") == {"rimlight", "rimlight.plan"}
    code = "from rimlight.inverse import photometric_stereo as ps\nimport numpy as np\nnp.ones(ps.read(x).images)"
    assert used(code) == {f"rimlight.inverse.photometric_stereo{rest}" for rest in ("", ".read")}


def test_pages_are_mended_once():
    """What furo and Sphinx lack for accessibility (`make browse` checks the pages in a browser)."""
    accessible = from_file(ROOT / "docs" / "_ext" / "accessible.py")
    for old, new in accessible.REPLACEMENTS.items():
        once = accessible.mend(f"<p>{old}</p>")
        assert once == accessible.mend(once) == f"<p>{new}</p>"


def test_films_are_small():
    films = list((ROOT / "docs" / "images" / "films").glob("*.webp"))
    assert films
    assert all(film.stat().st_size < 1_000_000 for film in films)
    assert sum(film.stat().st_size for film in films) < 6_000_000


def from_file(path: Path):
    """A module that is in no package."""
    specification = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(specification)
    sys.modules[path.stem] = module  # data classes look there
    specification.loader.exec_module(module)
    return module


def test_the_gallery_shows_every_scene():
    """Shipped scenes, with a picture of each entry; and the page is what `docs/make_gallery.py` writes."""
    gallery = from_file(ROOT / "docs" / "make_gallery.py")
    numbers = json.loads(gallery.NUMBERS.read_text("utf-8"))
    assert (ROOT / "docs" / "gallery.md").read_text("utf-8") == gallery.text(numbers)
    shown = {entry.scene for entry in gallery.ENTRIES}
    # Those for images alone are where these are measured.
    images = set(re.findall(r"bidirectional_(\w+)\.png", (ROOT / "docs" / "performance.md").read_text("utf-8")))
    assert {*scenes.names(), "room", "traffic_sign"} == shown | images
    assert not shown & images
    assert len(gallery.ENTRIES) >= 20
    assert {f"{entry.name}.webp" for entry in gallery.ENTRIES} == {p.name for p in gallery.FOLDER.glob("*.webp")}
