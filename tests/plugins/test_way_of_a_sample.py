"""How much a newcomer reads who follows one sample from `render_backward` to its gradient: docs/way_of_a_sample.md."""

from __future__ import annotations

import ast
import sys
from functools import cached_property
from pathlib import Path
from types import FrameType
from typing import Any

import cases
import drjit as dr
import mitsuba as mi
import pytest

#: What comes before the samples, the search for boundaries and the division into passes; and what comes after them, the
#: check of the result.
BESIDES = {"job", "passes", "refit", "zeros", "report_gradients"}


class Way:
    """The functions of Rimlight that are called in a term of a derivative, and those that `render_backward` calls for
    all of them. Constructors, properties, comprehensions and lambdas do not count, nor what they call.

    of : name of the file of the term.
    """

    def __init__(self, root: Path, of: str):
        self.roots, self.of = tuple(str(root / name) for name in ("plugins", "edge_sampling")), of
        self.functions: set[tuple[str, str]] = set()
        #: For each call that has not returned: does it count what it calls?
        self.open: list[bool] = []

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            self.open.append(self.counts(frame))
        elif event == "return" and self.open:
            self.open.pop()

    def counts(self, frame: FrameType) -> bool:
        code, file = frame.f_code, frame.f_code.co_filename
        within = bool(self.open) and self.open[-1]
        if not file.startswith(self.roots):
            return within
        if code.co_name == "render_backward":
            self.functions.add((file, code.co_name))
            return True
        if not within or code.co_name in BESIDES:
            return False
        if code.co_name in ("samples", "_samples") and Path(file).name != self.of:
            return False
        if code.co_name.startswith("<"):
            return True
        owner = frame.f_locals.get("self")
        is_property = isinstance(getattr(type(owner), code.co_name, None), (property, cached_property))
        if is_property or (code.co_name.startswith("__") and code.co_name != "__call__"):
            return False
        self.functions.add((file, f"{type(owner).__name__}.{code.co_name}" if owner is not None else code.co_name))
        return True


@pytest.mark.parametrize(("term", "functions", "files"), [("interior.py", 52, 13), ("film.py", 98, 21)])
def test_is_short(root, term, functions, files):
    scene, integrator = cases.shadow_blocker()(), mi.load_dict({"type": "direct_edge"})
    params = mi.traverse(scene)
    key = "blocker.vertex_positions"
    params.keep([key])
    dr.enable_grad(params[key])
    params.update()
    image = dr.ones(mi.TensorXf, (*scene.sensors()[0].film().size()[::-1], 3))
    integrator.render_backward(scene, params, image, spp=1)  # the edges are found
    way = Way(root, term)
    sys.setprofile(way)
    try:
        integrator.render_backward(scene, params, image, spp=1)
    finally:
        sys.setprofile(None)
    found = {file for file, _ in way.functions}
    print(*sorted(f"{Path(file).relative_to(root)}: {name}" for file, name in way.functions), sep="\n")
    print(len(way.functions), len(found))
    assert len(way.functions) <= functions
    assert len(found) <= files


def test_files_and_functions_are_short(root):
    files = [p for folder in ("plugins", "edge_sampling") for p in (root / folder).rglob("*.py")]
    assert files
    long = [p.name for p in files if len(p.read_text(encoding="utf-8").splitlines()) > 450]
    for p in files:
        nodes = ast.walk(ast.parse(p.read_text(encoding="utf-8")))
        functions = [n for n in nodes if isinstance(n, ast.FunctionDef)]
        long += [f"{p.name}: {f.name}" for f in functions if f.end_lineno - f.lineno >= 80]
    assert not long
