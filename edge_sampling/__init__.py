"""Sampling the edges at which an image jumps: the mechanism behind Rimlight's plugins. Registers nothing."""

from .edges import EdgeKind, Edges, find_edges
from .film_boundary import BoundarySamples, FilmBoundary
from .finite_differences import FiniteDifferences, finite_differences
from .meshes import Geometry, jumping_textures
from .motion import Motion, derivative_image
from .projection import Projection
from .shading_boundary import ShadingBoundary
from .zscores import mean_and_error, z_scores

__all__ = [
    "BoundarySamples",
    "EdgeKind",
    "Edges",
    "FilmBoundary",
    "FiniteDifferences",
    "Geometry",
    "Motion",
    "Projection",
    "ShadingBoundary",
    "derivative_image",
    "find_edges",
    "finite_differences",
    "jumping_textures",
    "mean_and_error",
    "z_scores",
]
