"""Do the axes of the lights point where those of the images do?

Mirrored lights predict the values of a diffuse surface as well, with mirrored normals. But these are not those of any
surface, mostly: on the way around a cell of four pixels, a surface comes back to its depth, and normals in wrong axes
do not. What is missing there, the curl of the slopes, is compared for all axes that may have been meant.

With x and y both mirrored, what bulges becomes hollow, which is a surface, too: images do not tell that.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .dataset import Dataset
from .integration import view_rays

#: Cells without which nothing is told; and images with light, without which normals are too uncertain.
CELLS, FEWEST = 50, 8

#: By which factor the curl must be larger than in other axes.
LARGER = 1.4

#: Slopes count up to this cosine between a normal and the direction to the camera.
LEAST_COSINE = 0.2

#: What maps normals in the axes of the lights to those of the images, and what to write for "x y". Both of a kind have
#: nearly the same curl.
X, Y = np.diag([-1.0, 1, 1]), np.diag([1.0, -1, 1])
EXCHANGED = np.eye(3)[[1, 0, 2]]
KINDS = {
    "as given": (np.eye(3), X @ Y),
    "mirrored": (Y, X),
    "exchanged": (EXCHANGED, X @ Y @ EXCHANGED),
    "turned by a right angle": (X @ EXCHANGED, Y @ EXCHANGED),
}
FOR_X_Y = {
    "mirrored": ("x -y", "-x y"),
    "exchanged": ("y x", "-y -x"),
    "turned by a right angle": ("-y x", "y -x"),
}


@dataclass(frozen=True)
class Axes:
    """curls : for each of `KINDS`, median size of the curl. bulging : of the kind with the least, which of both axes
    make an object whose outline turns away from the camera, 0 or 1. Both are empty where nothing is told."""

    curls: dict[str, float] = field(default_factory=dict)
    bulging: int = 0

    @property
    def kind(self) -> str:
        """The one that fits; "as given" unless another one does much better."""
        best = min(self.curls, key=self.curls.__getitem__, default="as given")
        clear = self.curls and self.curls["as given"] > LARGER * self.curls[best]
        return best if clear else "as given"

    def __str__(self) -> str:
        if not self.curls:
            return "not judged, too few images or pixels"
        return "curl of the slopes " + ", ".join(f"{kind} {curl:.2g}" for kind, curl in self.curls.items())

    def said(self, file: str) -> list[str]:
        """Warnings. file : of the lights."""
        if self.kind == "as given":
            return []
        ratio = min(self.curls["as given"] / max(self.curls[self.kind], 1e-12), 99)
        bulging, hollow = FOR_X_Y[self.kind] if self.bulging == 0 else FOR_X_Y[self.kind][::-1]
        mirrored = " Or the images are mirrored." * (self.kind == "mirrored")
        return [
            f"The axes of the lights seem to be {self.kind}: with them as they are, normals are {ratio:.1f} times as "
            f"far from those of any surface. x must point to the right in the images, y up. In {file}, write {bulging} "
            f"for x y if the object bulges, {hollow} if it is hollow. A ring of lights that is listed the "
            f"other way around, or from elsewhere, looks so, too.{mirrored}"
        ]


def judged(data: Dataset, normals: np.ndarray) -> Axes:
    """normals : (P, 3), in the axes of the lights."""
    mask = data.mask
    whole = mask[:-1, :-1] & mask[1:, :-1] & mask[:-1, 1:] & mask[1:, 1:]
    if whole.sum() < CELLS:
        return Axes()
    size = lambda axes: float(np.median(np.abs(_curl(data, normals @ axes.T, whole))))
    curls = {kind: min(size(axes) for axes in both) for kind, both in KINDS.items()}
    axes = KINDS[min(curls, key=curls.__getitem__)]
    return Axes(curls, int(_outwards(data, normals @ axes[0].T) < _outwards(data, normals @ axes[1].T)))


def _curl(data: Dataset, normals: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Of the slopes of depth that normals mean, for cells of four pixels, times squared cosines."""
    rays, steps = view_rays(data.mask, data.camera, 1.0)
    length = np.linalg.norm(rays, axis=1)
    cosine = np.maximum(-(normals * rays).sum(1) / length, LEAST_COSINE)
    u, v = (data.image(normals @ step / (length * cosine)) for step in steps)
    corners = lambda image: (image[:-1, :-1], image[:-1, 1:], image[1:, :-1], image[1:, 1:])
    (u0, u1, u2, u3), (v0, v1, v2, v3) = corners(u), corners(v)
    around = (u0 + u1 - u2 - u3 + v1 + v3 - v0 - v2) / 2
    weight = sum(corners(data.image(cosine))) / 4
    return (around * weight**2)[whole]


def _outwards(data: Dataset, normals: np.ndarray) -> float:
    """How far normals lean outwards at the outline of the mask."""
    inside = np.pad(data.mask.astype(float), 1)
    down, right = (np.gradient(inside, axis=axis)[1:-1, 1:-1][data.mask] for axis in (0, 1))
    return float((normals[:, 1] * down - normals[:, 0] * right).sum())
