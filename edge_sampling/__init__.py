"""Sampling the edges at which an image jumps: the mechanism behind Rimlight's plugins. Registers nothing."""

from .boundaries.deep_shadows import DeepShadows
from .boundaries.face_planes import FacePlanes
from .boundaries.film_boundary import BoundarySamples, FilmBoundary
from .boundaries.horizon import Horizon, Horizons
from .boundaries.indirect_beams import IndirectBeams
from .boundaries.indirect_shadows import IndirectShadows
from .boundaries.shading_boundary import ShadingBoundary
from .boundaries.shadow_boundary import ShadowBoundary, ShadowSamples
from .choice.edge_tree import EdgeTree
from .choice.sampling import EdgeSample, Reservoir, sample_edge, stratified
from .choice.silhouettes import Silhouettes
from .choice.views import Cone, Lobe, View
from .geometry.cracks import Cracks, close_cracks
from .geometry.cut_curves import CutCurves
from .geometry.edges import EdgeKind, Edges, Weld, find_edges, find_welded_edges
from .geometry.intersections import Intersections
from .geometry.meshes import Geometry, objects_below
from .geometry.rims import Rims
from .geometry.sources import Sources
from .geometry.texture_lines import TextureLines, jumping_textures, maps_in_steps
from .lights import Lights
from .projection.film_parts import Batch, FilmPart, film_parts
from .projection.sensors import Projection
from .smooth_lamps import SmoothLamps

__all__ = [
    "Batch",
    "BoundarySamples",
    "Cone",
    "Cracks",
    "CutCurves",
    "DeepShadows",
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
    "IndirectBeams",
    "IndirectShadows",
    "Intersections",
    "Lights",
    "Lobe",
    "Projection",
    "Reservoir",
    "Rims",
    "ShadingBoundary",
    "ShadowBoundary",
    "ShadowSamples",
    "Silhouettes",
    "SmoothLamps",
    "Sources",
    "TextureLines",
    "View",
    "Weld",
    "close_cracks",
    "film_parts",
    "find_edges",
    "find_welded_edges",
    "jumping_textures",
    "maps_in_steps",
    "objects_below",
    "sample_edge",
    "stratified",
]
