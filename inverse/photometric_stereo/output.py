"""What a reconstruction found, as files for other programs."""

from __future__ import annotations

import copy
import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import rimlight
from rimlight import ggx
from rimlight.edge_sampling.geometry.meshes import make_mesh
from rimlight.exr import replacing, write_exr
from rimlight.inverse import page

from .dataset import image_of
from .direct import bsdf_of
from .full_size import FullSize
from .integration import depth_error, mesh_of
from .reconstruction import Options, Result

#: What is written after each alternation.
NUMBERS = ("normals.exr", "depth.exr", "albedo.exr", "base.exr", "bsdf.json", "exposures.txt", "metadata.json")

#: Angles of incidence for which a BSDF is drawn, degrees.
INCIDENCES = (0, 30, 60)

#: What files say of normals and albedos.
AXES, OF_ALBEDO = {"axes": "x right, y up, z towards the camera"}, {"unit": "of bsdf.json"}

#: Resolution of pictures of plots, per inch.
DPI = 130


def snapshot(result: Result) -> Result:
    """A copy that further alternations leave alone."""
    return dataclasses.replace(result, guess=copy.deepcopy(result.guess), history=list(result.history))


def write_numbers(
    folder: Path, result: Result, options: Options, *, status: str, truth: np.ndarray | None = None, reduce: int = 1
) -> None:
    """Write what was found, each file at once: after an alternation, say, lest it is lost.

    ``normals.exr``, ``depth.exr``, ``albedo.exr``, of several materials ``base.exr``: 0 outside the mask, at the
    resolution reached. ``bsdf.json``: for the plugin ``ggx_dictionary``, see `bsdf`. ``exposures.txt``: a line for
    each image. ``metadata.json``.

    status : "running", "finished" or "interrupted". truth : (H, W), of depth. reduce : as of `dataset.read`.

    Raises
    ------
    OSError
    """
    folder.mkdir(parents=True, exist_ok=True)
    data, guess = result.data, result.guess
    unit = "pixels, towards the camera, mean 0"
    if data.camera is not None:
        unit = "along the axis, " + (
            "unknown unit, geometric mean 1" if data.distance is None else "unit of distance.txt"
        )
    write_exr(folder / "normals.exr", {"": data.image(guess.normals)}, AXES)
    write_exr(folder / "depth.exr", {"": data.image(depth(result))[..., None]}, {"unit": unit})
    write_exr(folder / "albedo.exr", {"": data.image(guess.albedo)[..., None]}, OF_ALBEDO)
    if guess.base is not None:
        write_exr(folder / "base.exr", {"": data.image(guess.base / result.scale)}, _of_base(result))
    weights, factor = bsdf(result)
    with replacing(folder / "bsdf.json") as temporary:
        ggx.write(temporary, result.lobes, weights)
    with replacing(folder / "exposures.txt") as temporary:
        np.savetxt(temporary, guess.exposures, "%.6g")
    content = {
        "status": status,
        "mean_angular_error_degrees": result.error,
        "depth_error": error_of_depth(result, truth),
        "verdict": result.verdict,
        "materials": "one" if guess.base is None else "several",
        "left_out": {name: None if np.isnan(error) else error for name, error in result.left_out.items()},
        "halves": {name: None if np.isnan(angle) else angle for name, angle in result.halves.items()},
        "curl": {name: None if np.isnan(angle) else angle for name, angle in result.curl.items()},
        "taken_back": result.taken_back,
        "strength": None if np.isnan(result.strength) else result.strength,
        "distance_of_lights_pixels": None if np.isinf(result.away) else result.away,
        "doubts": list(result.doubts),
        "seconds": round(result.seconds, 3),
        "size": [*data.mask.shape[::-1]],
        "pixels": len(data.values),
        "reduce": reduce,
        "images": list(data.names) or len(data.lights),
        "unit_of_depth": unit,
        "factor_of_bsdf": factor,
        "options": dataclasses.asdict(options),
        "versions": versions(),
        "history": result.history,
    }
    _write_metadata(folder, content)


def _write_metadata(folder: Path, content: dict[str, Any]) -> None:
    with replacing(folder / "metadata.json") as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", "utf-8")


def status(folder: Path) -> str | None:
    """Of the result in a folder, as of `write_numbers`; None if there is none."""
    try:
        return json.loads((folder / "metadata.json").read_text("utf-8"))["status"]
    except (OSError, ValueError, KeyError):
        return None


def write_pictures(folder: Path, result: Result) -> None:
    """Write ``normals.png``, 16 bits, (n + 1) / 2; ``bsdf.png``; ``mesh.ply``, a vertex at the centre of each pixel;
    ``uncertainty.exr``, if it is known: NaN outside the mask.

    Raises
    ------
    OSError
    """
    data = result.data
    _write_picture(folder / "normals.png", data.image(result.guess.normals.astype(np.float32), -1))
    (folder / "uncertainty.exr").unlink(missing_ok=True)
    if result.uncertainty is not None:
        degrees = data.image(result.uncertainty.astype(np.float32), np.nan)[..., None]
        write_exr(folder / "uncertainty.exr", {"": degrees}, {"unit": "degrees, standard error of the normals"})
    figure = bsdf_figure(result)
    FigureCanvasAgg(figure)
    with replacing(folder / "bsdf.png") as temporary:
        figure.savefig(temporary, format="png", dpi=DPI)
    vertices, faces, _ = mesh_of(data.image(depth(result)), data.mask, camera=data.camera)
    mesh = make_mesh("object", vertices, faces, normals=result.guess.normals)
    mesh.add_attribute("vertex_albedo", 1, result.guess.albedo.astype(np.float32))
    with replacing(folder / "mesh.ply") as temporary:
        mesh.write_ply(str(temporary))


def write_full_size(folder: Path, full: FullSize, result: Result) -> None:
    """Write the normals and albedos of full images, in files as those of the result, and ``metadata.json``.

    Raises
    ------
    OSError
    """
    folder.mkdir(parents=True, exist_ok=True)
    image = functools.partial(image_of, full.mask)
    write_exr(folder / "normals.exr", {"": image(full.normals)}, AXES)
    _write_picture(folder / "normals.png", image(full.normals, -1))
    if full.albedo is not None:
        write_exr(folder / "albedo.exr", {"": image(full.albedo)[..., None]}, OF_ALBEDO)
    else:
        write_exr(folder / "base.exr", {"": image(full.base / np.float32(result.scale))}, _of_base(result))
    size = {"size": [*full.mask.shape[::-1]], "pixels": len(full.normals)}
    _write_metadata(folder, {"mean_angular_error_degrees": full.error, **size, "versions": versions()})


def _of_base(result: Result) -> dict[str, str]:
    return {"unit": "diffuse colour, of the images", "coat": f"index of refraction {result.guess.base_eta:g}"}


def _write_picture(path: Path, normals: np.ndarray) -> None:
    """Of normals, (H, W, 3), 16 bits."""
    encoded = np.round((normals + 1) / 2 * 65535).astype(np.uint16)
    with replacing(path) as temporary:
        mi.Bitmap(encoded).write(str(temporary), mi.Bitmap.FileFormat.PNG)


# ---------------------- Parts of a result ----------------------


def judgement(result: Result) -> list[str]:
    """What the values that were left out say, in sentences; nothing before the last alternation."""
    if result.verdict == "not judged":
        kept = "The start is kept: of so few lights none can be left out, so nothing tells if another result is better."
        return [kept] if result.left_out else []
    start, found = (f"{100 * result.left_out[name]:.3g} %" for name in ("start", "result"))
    if result.verdict == "start":
        return [
            "The start is kept. No other state predicts values that were left out better, has normals that depend less "
            "on which lights tell them, and whose normals are those of a surface as well.",
            f"The start predicts values that were left out with a mean error of {start} of the mean value of a pixel.",
        ]
    sentences = [
        f"Values that were left out are predicted with a mean error of {found} of the mean value of a pixel; the start "
        f"predicts them with {start}."
    ]
    if np.isfinite(list(result.halves.values())).all():
        start, found = (f"{result.halves[name]:.2g}°" for name in ("start", "result"))
        sentences.append(
            f"Normals from one half of the lights and normals from the other half differ by {found}; those of the "
            f"start differ by {start}."
        )
    if np.isfinite(result.strength):
        sentences.append(
            f"Interreflections of the surface that was found are multiplied by {result.strength:.2f}, so that shadows "
            "are as bright as in the images."
        )
    if np.isfinite(result.away):
        sentences.append(
            f"The shading tells that the lights are near: {result.away:.0f} pixels from the middle of the object. They "
            "are taken to be all as far away, and the camera further."
        )
    if result.taken_back > 0:
        sentences.append(f"The start has a share of {100 * result.taken_back:.2g} % in the normals.")
    return sentences


def depth(result: Result) -> np.ndarray:
    """Of the pixels of the mask, (P,)."""
    return result.depth[result.domain.inner]


def error_of_depth(result: Result, truth: np.ndarray | None) -> float | None:
    """Mean absolute error after alignment, in the unit of the truth, (H, W); None where it is not known."""
    data = result.data
    if truth is None or truth.shape != data.mask.shape:
        return None
    align = "offset" if data.camera is None else "scale"
    return depth_error(data.image(depth(result)), truth, data.mask, align=align)


def bsdf(result: Result) -> tuple[np.ndarray, float]:
    """Weights, (B, 3), and the factor by which they must be multiplied to give the values of the images: 1, unless
    these are so bright that the weights would sum to more than 1."""
    weights = result.guess.weights / result.scale
    factor = max(float(weights.sum(0).max()), 1.0)
    return weights / factor, factor


def versions() -> dict[str, str]:
    return {"rimlight": rimlight.__version__, "mitsuba": mi.__version__, "drjit": dr.__version__}


# ---------------------- Plot of the BSDF ----------------------


def reflected(bsdf: mi.BSDF, incidence: float, outgoing: np.ndarray) -> np.ndarray:
    """f cos θₒ in the plane of incidence, (N, 3).

    incidence : degrees. outgoing : (N,), degrees; the mirror direction is that of the incidence.
    """
    sin, cos = np.sin(np.radians([incidence, *outgoing])), np.cos(np.radians([incidence, *outgoing]))
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(float(-sin[0]), 0, float(cos[0]))
    wo = mi.Vector3f(mi.Float(sin[1:].astype(np.float32)), 0, mi.Float(cos[1:].astype(np.float32)))
    return np.array(bsdf.eval(mi.BSDFContext(), si, wo)).T


def bsdf_figure(result: Result) -> Figure:
    """Slices of the BSDF, one plot for each colour."""
    weights, _ = bsdf(result)
    found = bsdf_of(result.lobes, weights)
    outgoing = np.linspace(-89, 89, 357)
    figure = Figure(figsize=(9, 3), layout="constrained")
    for c, (axes, colour) in enumerate(zip(figure.subplots(1, 3, sharey=True), ("red", "green", "blue"), strict=True)):
        for i, incidence in enumerate(INCIDENCES):
            values = reflected(found, incidence, outgoing)[:, c]
            axes.plot(outgoing, values, color=page.COLOURS[i], linewidth=1.3, label=f"θᵢ = {incidence}°")
        axes.set(xlabel="θₒ, degrees", ylabel="" if c else "f cos θₒ, 1/sr")
        axes.set_title(colour, fontsize=9, color=page.INK)
        if weights.any():  # else there is no glaze over the diffuse colours
            axes.set_yscale("log")
            axes.set_ylim(bottom=max(axes.get_ylim()[0], axes.get_ylim()[1] * 1e-4))
        page.paint(axes)
        if c == 0:
            axes.legend(fontsize=7.5, labelcolor=page.INK, framealpha=0, edgecolor="none")
    return figure
