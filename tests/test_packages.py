"""The files that describe the packages agree with each other and with the code."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import sys
import tarfile

import distribution
import pytest

import rimlight
from rimlight import checks, inverse
from rimlight.inverse import photometric_stereo

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


@pytest.fixture(scope="module")
def project(root) -> dict:
    return tomllib.loads((root / "pyproject.toml").read_text("utf-8"))


def test_there_is_one_version(root, project):
    assert "version" in project["project"]["dynamic"]
    assert re.search(r"^version: (.+)$", (root / "CITATION.cff").read_text("utf-8"), re.MULTILINE)[1] == (
        rimlight.__version__
    )
    newest = re.search(r"^## (\S+)", (root / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)[1]
    assert newest in (rimlight.__version__, "unreleased")


def test_all_packages_are_in_the_wheel(root, project):
    folders = {file.parent.relative_to(root) for top in ("plugins", "edge_sampling", "inverse", "scenes")
               for file in (root / top).rglob("__init__.py")}  # fmt: skip
    name = lambda folder: ".".join(("rimlight", *folder.parts[folder.parts[0] == "plugins" :]))
    assert set(project["tool"]["setuptools"]["packages"]) == {name(folder) for folder in folders}


def test_pythons_are_named_once(project):
    named = re.findall(r":: (3\.\d+)", "\n".join(project["project"]["classifiers"]))
    assert project["project"]["requires-python"] == f">={named[0]}"


@pytest.mark.parametrize("module", [rimlight, checks, inverse, photometric_stereo], ids=lambda m: m.__name__)
def test_public_functions_have_types(module):
    """Of all parameters and results, as `py.typed` promises."""
    untyped = []
    for name in set(module.__all__) - {"__version__"}:
        thing = getattr(module, name)
        is_protocol = getattr(thing, "_is_protocol", False)
        function = thing.__call__ if is_protocol else thing.__init__ if inspect.isclass(thing) else thing
        if not inspect.isfunction(inspect.unwrap(function)):
            continue
        signature = inspect.signature(function)
        given = [p.annotation for k, p in signature.parameters.items() if k != "self"]
        if not inspect.isclass(thing):
            given.append(signature.return_annotation)
        if inspect.Signature.empty in given:
            untyped.append(name)
    assert not untyped


def test_methods_take_what_those_take_that_they_override():
    """By position: a caller does not know which of the two it calls."""
    positional = lambda f: [p.name for p in inspect.signature(f).parameters.values() if p.kind is not p.KEYWORD_ONLY]
    wrong, overridden = [], 0
    for found in pkgutil.walk_packages(rimlight.__path__, "rimlight."):
        if found.name.endswith("__main__"):
            continue
        classes = [c for c in vars(importlib.import_module(found.name)).values() if inspect.isclass(c)]
        for cls in (c for c in classes if c.__module__ == found.name):
            for name, method in vars(cls).items():
                above = next((vars(b)[name] for b in cls.__mro__[1:] if name in vars(b)), None)
                if name.startswith("__") or not (inspect.isfunction(method) and inspect.isfunction(above)):
                    continue
                if above.__module__.startswith("rimlight."):
                    overridden += 1
                    if positional(method)[: len(positional(above))] != positional(above):
                        wrong.append(f"{cls.__qualname__}.{name}")
    assert overridden and not wrong


@pytest.mark.parametrize("module", [rimlight, checks, inverse, photometric_stereo], ids=lambda m: m.__name__)
def test_the_api_page_lists_the_public_interface(root, module):
    """`register` is called by the package itself."""
    page = (root / "docs" / "api.md").read_text("utf-8")
    listed = set(re.findall(r"^\.\. auto(?:class|function):: (?:\w+\.)*(\w+)$", page, re.MULTILINE))
    assert set(module.__all__) - listed <= {"__version__", "register"}


def test_ten_lines_are_ten(root):
    """The README says so."""
    code = distribution.ten_lines((root / "README.md").read_text("utf-8"))
    assert code.startswith("import rimlight") and "dr.backward" in code
    lines = [line for line in ast.parse(code).body if not isinstance(line, ast.Import | ast.ImportFrom)]
    assert len(lines) <= 10


def test_archives_do_not_depend_on_the_disk(tmp_path):
    """Neither on the order of files, nor on their times and owners."""
    archives = []
    for order, time in (("ab", 1), ("ba", 2)):
        archives.append(tmp_path / f"{order}.tar.gz")
        with tarfile.open(archives[-1], "w:gz") as archive:
            for name in order:
                file = tmp_path / name
                file.write_text(name)
                entry = archive.gettarinfo(file, name)
                entry.mtime = time
                with file.open("rb") as content:
                    archive.addfile(entry, content)
        distribution.normalise(archives[-1], 1000)
    assert distribution.digest(archives[0]) == distribution.digest(archives[1])
    with tarfile.open(archives[0]) as archive:
        assert [(e.name, archive.extractfile(e).read()) for e in archive] == [("a", b"a"), ("b", b"b")]


def test_arguments_are_not_changed_in_place(root):
    """`active &= …` changes the array of the caller. (Bodies of loops may: what they are given is their own.)"""
    changed = []
    for file in (f for top in ("plugins", "edge_sampling") for f in (root / top).rglob("*.py")):
        for function in functions(ast.parse(file.read_text("utf-8"))):
            args = function.args
            arguments = {a.arg for a in (*args.posonlyargs, *args.args, *args.kwonlyargs)}
            for node in statements(function):
                if isinstance(node, ast.Assign):
                    arguments -= {n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)}
                elif isinstance(node, ast.AugAssign) and getattr(node.target, "id", None) in arguments:
                    changed.append(f"{file.relative_to(root)}:{node.lineno}: {ast.unparse(node)}")
    assert not changed


def functions(tree: ast.Module) -> list[ast.FunctionDef]:
    """Those of a module and of its classes, but not those within functions."""
    bodies = [tree.body, *(node.body for node in ast.walk(tree) if isinstance(node, ast.ClassDef))]
    return [node for body in bodies for node in body if isinstance(node, ast.FunctionDef)]


def statements(node: ast.AST) -> list[ast.AST]:
    """Below a node in the order of the text, but for those of functions within."""
    found = []
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.FunctionDef | ast.Lambda):
            found += [child, *statements(child)]
    return found
