"""The terms, in their order."""

from __future__ import annotations

from .faces import FacePlanesTerm
from .film import FilmTerm
from .indirect import IndirectShadowsTerm
from .interior import InteriorTerm
from .mirrors import MirrorsTerm
from .points import PointsTerm
from .shadows import ShadowsTerm
from .term import Term

#: In this order: path replay, in the first, needs that nothing else is attached to the parameters.
TERMS: tuple[Term, ...] = (
    InteriorTerm(),
    FilmTerm(),
    MirrorsTerm(),
    ShadowsTerm(),
    PointsTerm(),
    IndirectShadowsTerm(),
    FacePlanesTerm(),
)
