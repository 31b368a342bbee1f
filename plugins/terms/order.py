"""The terms, in their order."""

from __future__ import annotations

from .bisection import BisectionTerm
from .faces import FacePlanesTerm
from .film import FilmTerm
from .horizons import HorizonsTerm
from .indirect import IndirectShadowsTerm
from .interior import InteriorTerm
from .mirrored import MirroredTerm
from .passing import PassingTerm
from .points import PointsTerm
from .shadows import ShadowsTerm
from .term import Term

#: In this order: path replay, in the first, needs that nothing else is attached to the parameters.
TERMS: tuple[Term, ...] = (
    InteriorTerm(),
    PassingTerm(),
    FilmTerm(),
    BisectionTerm(),
    ShadowsTerm(),
    PointsTerm(),
    IndirectShadowsTerm(),
    FacePlanesTerm(),
    HorizonsTerm(),
    MirroredTerm(),
)
