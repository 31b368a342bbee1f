"""Inverse rendering: fits of pose, material, light and shape, through the public interface of Mitsuba.

import mitsuba as mi
from rimlight import inverse

problem = inverse.read("fit.toml")
found = inverse.fit(problem, out="result")
inverse.write("result", found, title="My fit")
"""

from .executors import Cluster, Processes
from .fitting import Fit, ViewOfFit, fit
from .problem import Free, Loss, Problem, Stage, Starts, Target, read
from .report import write, write_report

__all__ = [
    "Cluster",
    "Fit",
    "Free",
    "Loss",
    "Problem",
    "Processes",
    "Stage",
    "Starts",
    "Target",
    "ViewOfFit",
    "fit",
    "read",
    "write",
    "write_report",
]
