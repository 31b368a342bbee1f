"""Manual pages from the docstrings of plugins, which are written with the directives of Mitsuba's own manual.

``.. plugin-page:: direct_edge`` inserts the page of a plugin. Known inside of it: ``pluginparameters``, ``tabs`` with
``code-tab``, ``:monosp:``, and the substitutions ``|int|`` etc.
"""

from __future__ import annotations

import inspect

import mitsuba as mi
from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.nodes import nested_parse_with_titles

from rimlight._registration import plugin_modules

KINDS = ("float", "string", "spectrum", "texture", "point", "vector", "transform", "tensor", "object")
TYPES = {"int": "integer", "bool": "boolean"} | {k: k for k in KINDS}
FLAGS = {"exposed": "P", "differentiable": "∂", "discontinuous": "D"}


def plugin_class(name: str) -> type:
    """The class whose manual page is that of the plugin. Not every plugin can be loaded without parameters."""
    (module,) = (m for k, m in plugin_modules(mi.variant()).items() if k.rpartition(".")[2] == name)
    return next(c for c in vars(module).values() if inspect.isclass(c) and f":monosp:`{name}`" in (c.__doc__ or ""))


class PluginPage(SphinxDirective):
    """Insert the docstring of a plugin's class. The argument is its name."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        (name,) = self.arguments
        plugin = plugin_class(name)
        source = inspect.getsourcefile(plugin) or name
        self.env.note_dependency(source)
        text = StringList(inspect.getdoc(plugin).splitlines(), source=source)
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
    """A block of code in a tab. The argument is its language."""

    has_content = True
    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        language = self.arguments[0]
        title = {"xml": "XML", "python": "Python"}.get(language, language)
        code = [f"        {line}" for line in self.content]
        lines = [f".. tab:: {title}", "", f"    .. code-block:: {language}", "", *code]
        container = nodes.Element()
        self.state.nested_parse(StringList(lines, source="code-tab"), self.content_offset, container)
        return container.children


class Tabs(Directive):
    """A group of ``code-tab``."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        container = nodes.Element()
        self.state.nested_parse(self.content, self.content_offset, container)
        return container.children


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
