"""Inverse rendering: fits of pose, material, light and shape, through the public interface of Mitsuba.

import mitsuba as mi
from rimlight import inverse

problem = inverse.read("fit.toml")
found = inverse.fit(problem, out="result")
inverse.write("result", found, title="My fit")
"""

from .executors import Cluster
from .fitting import Fit, fit
from .losses import Loss, LossFunction, drjit_loss
from .problem import Free, Problem, Stage, Starts, Target, read
from .progress import Step
from .regularisers import prior, smooth_mesh, smooth_texture
from .report import write, write_report
from .result import Result, ViewOfFit
from .torch_bridge import torch_loss, torch_render
from .watching import Watch
from .workers import Workers

__all__ = [
    "Cluster",
    "Fit",
    "Free",
    "Loss",
    "LossFunction",
    "Problem",
    "Result",
    "Stage",
    "Starts",
    "Step",
    "Target",
    "ViewOfFit",
    "Watch",
    "Workers",
    "drjit_loss",
    "fit",
    "prior",
    "read",
    "smooth_mesh",
    "smooth_texture",
    "torch_loss",
    "torch_render",
    "write",
    "write_report",
]
