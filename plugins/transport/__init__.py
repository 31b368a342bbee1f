"""Light along paths: the radiance that arrives along camera rays, and its interior derivative."""

from .cut_rays import CutRays
from .paths import Depths, Replay, Vertex
from .scattering import Scattering
from .tracer import PathTracer, Radiance

__all__ = ["CutRays", "Depths", "PathTracer", "Radiance", "Replay", "Scattering", "Vertex"]
