"""Pictures for people, all PNG files: images of linear radiance, signed derivatives, panels side by side, curves.

Images are NumPy arrays or Mitsuba tensors of shape (H, W, C), linear. Derivatives are shown as the mean of their colour
channels, red where the image gets brighter and blue where it gets darker.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import matplotlib.image
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rimlight.exr import replacing

COLOUR_MAP = "RdBu_r"
DPI = 130


@dataclass(frozen=True)
class Panel:
    """One picture in a row.

    image : (H, W, C), linear.
    caption : text above it; may have several lines.
    kind : "image" (radiance, shown in sRGB) or "derivative" (signed, shown by a colour map).
    """

    image: Any
    caption: str
    kind: Literal["image", "derivative"] = "image"


def to_srgb(image: Any) -> np.ndarray:
    """Linear radiance as sRGB for the screen: (H, W, 3), uint8. Alpha is dropped; grey images are repeated."""
    a = np.asarray(image, np.float32)
    a = np.repeat(a, 3, axis=2) if a.shape[2] == 1 else a[:, :, :3]
    a = np.clip(np.nan_to_num(a), 0, 1)
    a = np.where(a <= 0.0031308, 12.92 * a, 1.055 * np.maximum(a, 0.0031308) ** (1 / 2.4) - 0.055)
    return (a * 255 + 0.5).astype(np.uint8)


def signed(derivative: Any) -> np.ndarray:
    """Mean of the colour channels of a derivative: (H, W)."""
    return np.asarray(derivative, np.float32)[:, :, :3].mean(2)


def symmetric_limit(derivatives: Sequence[Any], percentile: float = 99) -> float:
    """A scale ±limit that fits all derivatives: the percentile of their absolute values that are not 0. Never 0."""
    values = np.concatenate([np.zeros(0), *(np.abs(signed(d)).ravel() for d in derivatives)])
    values = values[np.isfinite(values) & (values > 0)]
    return float(np.percentile(values, percentile)) if values.size else 1.0


def write_image(path: str | Path, image: Any) -> None:
    """Write an image pixel by pixel, in sRGB."""
    with replacing(path) as temporary:
        matplotlib.image.imsave(temporary, to_srgb(image))


def write_derivative(path: str | Path, derivative: Any, *, title: str, unit: str) -> None:
    """Write a derivative with a colour bar.

    title : what moved. unit : unit of the parameter θ; the bar says "radiance per ``unit``".
    """
    figure, (axes,) = _row(1)
    axes.set_title(title, fontsize=9, wrap=True)
    _bar(figure, axes, _show_signed(axes, derivative, symmetric_limit([derivative])), unit)
    _save(figure, path)


def write_panels(
    path: str | Path, panels: Sequence[Panel], *, title: str = "", unit: str = "", limit: float | None = None
) -> None:
    """Write pictures in a row. All derivatives share one symmetric scale, and its colour bar.

    unit : as in `write_derivative`; none for a difference of images.
    limit : end of the scale. Default: one that fits them all.
    """
    figure, row = _row(len(panels))
    derivatives = [p.image for p in panels if p.kind == "derivative"]
    limit = limit or symmetric_limit(derivatives)
    mappable = None
    for axes, panel in zip(row, panels, strict=True):
        axes.set_title(panel.caption, fontsize=9)
        if panel.kind == "derivative":
            mappable = _show_signed(axes, panel.image, limit)
        else:
            axes.imshow(to_srgb(panel.image), interpolation="nearest")
    if mappable is not None:
        _bar(figure, list(row), mappable, unit)
    if title:
        figure.suptitle(title, fontsize=10)
    _save(figure, path)


def write_curves(path: str | Path, curves: Mapping[str, Sequence[float]], *, x: str, y: str) -> None:
    """Write curves over the iterations, on a logarithmic scale. curves : label -> values; x, y : names of the axes."""
    figure = Figure(figsize=(6, 3), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for label, values in curves.items():
        axes.semilogy(np.asarray(values, np.float64), label=label, linewidth=1.2)
    axes.set(xlabel=x, ylabel=y)
    axes.grid(alpha=0.3)
    if len(curves) > 1:
        axes.legend()
    _save(figure, path)


def _row(count: int) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(3.1 * count + 0.6, 3.6), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    row = list(figure.subplots(1, count, squeeze=False)[0])
    for axes in row:
        axes.set_xticks([])
        axes.set_yticks([])
    return figure, row


def _show_signed(axes: Axes, derivative: Any, limit: float) -> Any:
    return axes.imshow(signed(derivative), cmap=COLOUR_MAP, vmin=-limit, vmax=limit, interpolation="nearest")


def _bar(figure: Figure, axes: Any, mappable: Any, unit: str) -> None:
    bar = figure.colorbar(
        mappable, ax=axes, extend="both", fraction=0.046 if isinstance(axes, Axes) else 0.03, pad=0.02
    )
    bar.set_label(f"radiance per {unit}" if unit else "radiance", fontsize=8)
    bar.ax.tick_params(labelsize=7)


def _save(figure: Figure, path: str | Path) -> None:
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")
