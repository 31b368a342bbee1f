"""The parameters of a scene, as `mi.traverse` finds them, which takes twice as long: much in a step of milliseconds."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import mitsuba as mi

#: What meshes know of their vertices besides colours and the like.
OF_VERTICES = "vertex_positions", "vertex_normals", "vertex_texcoords"


class Parameter(NamedTuple):
    """One parameter: its name (that of `mi.traverse`, but where two are alike), whose it is, and where its value is."""

    name: str
    node: mi.Object
    place: Any
    kind: Any

    @property
    def value(self) -> Any:
        return self.place if self.kind is None else mi.get_property(self.place, self.kind, self.node)


def may_brighten(parameter: Parameter) -> bool:
    """May a surface become brighter that reflects nothing, as the parameter changes? Of materials, their textures, and
    the colours of meshes."""
    name = parameter.name.rpartition(".")[2]
    if isinstance(parameter.node, mi.Shape):
        return name.startswith(("vertex_", "face_")) and name not in OF_VERTICES
    return isinstance(parameter.node, mi.BSDF | mi.Texture)


def parameters(scene: mi.Scene) -> list[Parameter]:
    """All of them. They refer to the scene: not to be kept."""
    return _traversal(mi.variant())(scene).found


@cache
def _traversal(variant: str) -> type:
    """The class that Mitsuba calls back. Made once: to make a class takes longer than to visit a small scene."""

    class Traversal(mi.TraversalCallback):
        def __init__(self, root: mi.Object):
            super().__init__()
            self.found: list[Parameter] = []
            self.seen, self.queue = {root}, [(root, "")]
            # One after the other: Mitsuba cannot call a method back that is still running.
            for node, prefix in self.queue:  # grows as it goes
                self.node, self.prefix = node, prefix
                node.traverse(self)

        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            if not isinstance(value, mi.Object):
                self.found.append(Parameter(self.prefix + name, self.node, value, cpptype))
            elif value not in self.seen:
                self.seen.add(value)
                self.queue.append((value, f"{self.prefix}{name}."))

        put_value = put_object = put

    return Traversal
