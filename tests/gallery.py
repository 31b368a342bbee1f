"""Pictures of all derivatives that were compared, on one page: `make test-full` writes `build/derivatives/index.html`.

Each test keeps its pictures in a file of its own, so that tests may run in several processes; when all have run, the
page is made of what is there.
"""

from __future__ import annotations

import html
import json
import os
import shutil
from pathlib import Path

import matplotlib
import numpy as np

from rimlight.checks import Agreement, FiniteDifferences, mean_and_error, z_scores
from rimlight.inverse.page import number, page, picture
from rimlight.pictures import COLOUR_MAP, signed, symmetric_limit, to_srgb

FOLDER = Path(__file__).resolve().parents[1] / "build" / "derivatives"

#: End of the scale of z-scores.
Z = 5.0


def wanted() -> bool:
    return "RIMLIGHT_FULL" in os.environ


def clear() -> None:
    shutil.rmtree(FOLDER, ignore_errors=True)


def keep(
    name: str,
    image: np.ndarray,
    derivatives: np.ndarray,
    reference: FiniteDifferences,
    agreement: Agreement,
    faults: list[str],
) -> None:
    """Keep the pictures of a comparison.

    image : (H, W, C), linear. derivatives : one for each run, (N, H, W, C).
    """
    FOLDER.mkdir(parents=True, exist_ok=True)
    mean, error = mean_and_error(derivatives)
    z = z_scores(mean, error, reference.mean, reference.standard_error, reference.step_error)
    unit = str(reference.settings.get("unit", ""))
    words = {"name": name, "numbers": agreement.numbers(), "faults": faults, "square": agreement.square, "unit": unit}
    arrays = {"image": image, "derivative": mean, "reference": reference.mean, "z": z}
    np.savez(FOLDER / f"{name}.npz", words=json.dumps(words), **{k: np.float32(a) for k, a in arrays.items()})


def write() -> Path | None:
    """Make the page of what was kept, and return where it is; None if nothing was."""
    found = []
    for file in sorted(FOLDER.glob("*.npz")):
        with np.load(file) as stored:
            words = json.loads(str(stored["words"]))
            found.append((words, {k: stored[k] for k in ("image", "derivative", "reference", "z")}))
    if not found:
        return None
    worst_first = lambda pair: (not pair[0]["faults"], -pair[0]["square"])
    found.sort(key=worst_first)
    wrong = sum(bool(words["faults"]) for words, _ in found)
    count = f"{len(found)} case{'s' * (len(found) != 1)}"
    verdict = f"{wrong} of {count} disagree." if wrong else f"All agree ({count})."
    body = [
        "<h1>Derivatives and finite differences</h1>",
        f'<p class="verdict"><span class="status{" bad" * bool(wrong)}">{verdict}</span></p>',
        "<p>The worst first: those that disagree, then by the largest |z| of squares of 4 × 4 pixels. Red is where the "
        "image gets brighter, blue where it gets darker; derivative and reference share one scale. The last picture is "
        f"the difference of both in standard errors, from −{Z:.0f} to {Z:.0f}.</p>",
        *(_section(words, arrays) for words, arrays in found),
    ]
    path = FOLDER / "index.html"
    path.write_text(page("Derivatives and finite differences", "\n".join(body)), "utf-8")
    return path


def _section(words: dict, arrays: dict[str, np.ndarray]) -> str:
    derivative, reference = arrays["derivative"], arrays["reference"]
    limit = symmetric_limit([derivative, reference])
    per = f" per {words['unit']}" if words["unit"] else ""
    scale = f"from {number(-limit, 2)} to {number(limit, 2)}{per}"
    panels = [
        ("image", to_srgb(arrays["image"])),
        (f"derivative, {scale}", _coloured(derivative, limit)),
        ("reference", _coloured(reference, limit)),
        ("z", _coloured(arrays["z"], Z)),
    ]
    name, figures = words["name"], ""
    for caption, image in panels:
        figures += (
            f"<figure>{picture(image, f'{name}: {caption}')}<figcaption>{html.escape(caption)}</figcaption></figure>"
        )
    faults = "".join(f'<p class="status bad">{html.escape(fault)}</p>' for fault in words["faults"])
    numbers = "; ".join(f"{what} {value}" for what, value in words["numbers"].items())
    columns = "display: grid; grid-template-columns: repeat(4, minmax(0, 1fr)); gap: 1rem"
    return (
        f'<h2>{html.escape(name)}</h2>\n{faults}\n<p>{html.escape(numbers)}</p>\n<div style="{columns}">{figures}</div>'
    )


def _coloured(values: np.ndarray, limit: float) -> np.ndarray:
    """The mean of the channels in colours: (H, W, 3), uint8."""
    scaled = np.clip(signed(values) / (2 * limit) + 0.5, 0, 1)
    return matplotlib.colormaps[COLOUR_MAP](scaled, bytes=True)[:, :, :3]
