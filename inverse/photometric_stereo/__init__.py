"""Photometric stereo with interreflections and unknown reflectance (Bangaru 2019)::

    from rimlight.inverse import photometric_stereo as ps

    result = ps.reconstruct(ps.read("bearPNG"))
    result.guess.normals, result.depth, result.error

A variant of Mitsuba must be set, such as ``llvm_ad_rgb``.
"""

from .dataset import Dataset, angles, read, write
from .integration import depth_error, integrate, mesh_of, normals_of
from .reconstruction import Options, Result, reconstruct
from .refinement import Descent

__all__ = [
    "Dataset",
    "Descent",
    "Options",
    "Result",
    "angles",
    "depth_error",
    "integrate",
    "mesh_of",
    "normals_of",
    "read",
    "reconstruct",
    "write",
]
