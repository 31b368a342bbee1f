"""The terms of a derivative: one interior term, and one for each kind of boundary.

A term says what it costs (`planned`), and makes film samples (`samples`), of which only the gradient counts. Terms add
up in the order of `TERMS`; each draws its random numbers by a seed of its own (`sampling.py`).
"""

from .faces import FacePlanesTerm
from .film import FilmTerm
from .interior import InteriorTerm
from .points import PointsTerm
from .sampling import Counts
from .shadows import ShadowsTerm
from .term import FilmSamples, Job, Sample, Term

#: In this order: path replay, in the first, needs that nothing else is attached to the parameters.
TERMS: tuple[Term, ...] = (InteriorTerm(), FilmTerm(), ShadowsTerm(), PointsTerm(), FacePlanesTerm())

__all__ = ["TERMS", "Counts", "FilmSamples", "Job", "Sample", "Term"]
