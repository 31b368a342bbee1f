"""Manual pages from the docstrings of plugins, which are written with the directives of Mitsuba's own manual.

``.. plugin-page:: integrator direct_edge`` inserts the page of a plugin. Known inside of it: ``pluginparameters``, ``tabs`` with
``code-tab``, ``:monosp:``, and the substitutions ``|int|`` etc.
"""

from __future__ import annotations

import inspect
from typing import ClassVar

import mitsuba as mi
from docutils import nodes
from docutils.parsers.rst import Directive, directives
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.nodes import nested_parse_with_titles

TYPES = {"int": "integer", "bool": "boolean", "float": "float", "string": "string", "spectrum": "spectrum"}
FLAGS = {"exposed": "P", "differentiable": "∂", "discontinuous": "D"}


class PluginPage(SphinxDirective):
    """Insert the docstring of a plugin's class. Arguments: kind (``integrator``, ...) and name of the plugin."""

    required_arguments = 2

    def run(self) -> list[nodes.Node]:
        _, name = self.arguments
        plugin = mi.load_dict({"type": name})
        source = inspect.getsourcefile(type(plugin)) or name
        self.env.note_dependency(source)
        text = StringList(inspect.getdoc(type(plugin)).splitlines(), source=source)
        container = nodes.Element(document=self.state.document)
        nested_parse_with_titles(self.state, text, container)
        return container.children


class PluginParameters(Directive):
    """A table from a list of lists: name, type, default or flags, meaning."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        body = nodes.Element()
        self.state.nested_parse(self.content, self.content_offset, body)
        rows = [item.next_node(nodes.bullet_list).children for item in body.next_node(nodes.bullet_list).children]
        width = max(map(len, rows))
        table, group = nodes.table(classes=["colwidths-auto"]), nodes.tgroup(cols=width)
        group += [nodes.colspec(colwidth=1) for _ in range(width)]
        tbody = nodes.tbody()
        for row in rows:
            cells = [nodes.entry("", *item.children) for item in row]
            for paragraph in cells[0].findall(nodes.paragraph):
                paragraph.replace_self(nodes.paragraph("", "", nodes.literal(text=paragraph.astext())))
            tbody += nodes.row("", *cells, *[nodes.entry() for _ in range(width - len(cells))])
        table += group
        group += tbody
        return [table]


class CodeTab(Directive):
    """One of the tabs below ``tabs``: a block of code with its language above."""

    has_content = True
    required_arguments = 1
    option_spec: ClassVar = {"name": directives.unchanged}

    def run(self) -> list[nodes.Node]:
        code = "\n".join(self.content)
        language = self.arguments[0]
        title = nodes.paragraph("", "", nodes.strong(text={"xml": "XML", "python": "Python"}.get(language, language)))
        return [title, nodes.literal_block(code, code, language=language)]


class Tabs(Directive):
    has_content = True

    def run(self) -> list[nodes.Node]:
        body = nodes.container()
        self.state.nested_parse(self.content, self.content_offset, body)
        return [body]


def monosp(role, rawtext, text, lineno, inliner, options=None, content=None):
    return [nodes.literal(text=text)], []


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("plugin-page", PluginPage)
    app.add_directive("pluginparameters", PluginParameters)
    app.add_directive("tabs", Tabs)
    app.add_directive("code-tab", CodeTab)
    app.add_role("monosp", monosp)
    substitutions = {**{k: f"*{v}*" for k, v in TYPES.items()}, **FLAGS}
    app.config.rst_prolog = "\n".join(f".. |{k}| replace:: {v}" for k, v in substitutions.items()) + "\n"
    return {"parallel_read_safe": True}
