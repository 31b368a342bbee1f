"""Sampling the edges at which an image jumps: the mechanism behind Rimlight's plugins. Registers nothing."""

from .batch import Batch, FilmPart, film_parts
from .edge_importance import Cone, EdgeSample, Lobe, View, resample, sample_edge, stratified
from .edge_tree import EdgeTree
from .edges import EdgeKind, Edges, Weld, find_edges, find_welded_edges
from .face_planes import FacePlanes
from .film_boundary import BoundarySamples, FilmBoundary
from .horizon import Horizon, Horizons
from .intersections import intersecting_meshes, t_junctions
from .lights import Lights, has_hard_beam
from .meshes import Geometry, jumping_textures, objects_below
from .projection import Projection
from .shading_boundary import ShadingBoundary
from .shadow_boundary import ShadowBoundary, ShadowSamples
from .silhouettes import Silhouettes
from .smooth_lamps import SmoothLamps
from .sources import Sources

__all__ = [
    "Batch",
    "BoundarySamples",
    "Cone",
    "EdgeKind",
    "EdgeSample",
    "EdgeTree",
    "Edges",
    "FacePlanes",
    "FilmBoundary",
    "FilmPart",
    "Geometry",
    "Horizon",
    "Horizons",
    "Lights",
    "Lobe",
    "Projection",
    "ShadingBoundary",
    "ShadowBoundary",
    "ShadowSamples",
    "Silhouettes",
    "SmoothLamps",
    "Sources",
    "View",
    "Weld",
    "film_parts",
    "find_edges",
    "find_welded_edges",
    "has_hard_beam",
    "intersecting_meshes",
    "jumping_textures",
    "objects_below",
    "resample",
    "sample_edge",
    "stratified",
    "t_junctions",
]
