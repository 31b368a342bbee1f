"""How the first view of a fit changed, as a video or a GIF."""

from __future__ import annotations

import io
import logging
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from rimlight import pictures
from rimlight.exr import replacing

from . import page
from .result import Result
from .targets import resample

log = logging.getLogger(__name__)

#: Frames per second, and frames for which the last one stays.
FPS, HOLD = 10, 15

#: Size to which small pictures of the animation are enlarged, and of larger ones; pixels.
ENLARGED, LARGEST = 320, 400

#: Largest size of an animation, bytes. Longer ones lose every second picture.
MOST = 4_000_000

#: Around the pictures, and height of the text below them; pixels.
MARGIN, TEXT = 8, 26


def write_animation(folder: Path, result: Result) -> Path:
    """Write how the first view changed: ``convergence.mp4`` if ffmpeg is there, else ``convergence.gif``.

    Returns
    -------
    The file. Its pictures are `result.frames`, with the target, or the scene as it was, to their right.

    Raises
    ------
    OSError : it cannot be written.
    """
    frames = [_beside_target(step, image, result.views[0].target, goal(result)) for step, image in result.frames]
    if program := shutil.which("ffmpeg"):
        try:
            return _write_video(folder / "convergence.mp4", frames, program)
        except (OSError, subprocess.SubprocessError) as error:
            log.info("ffmpeg makes no video (%s), a GIF is written instead", error)
    return _write_gif(folder / "convergence.gif", frames)


def _beside_target(step: int, image: np.ndarray, target: np.ndarray, goal: str) -> Image.Image:
    image = page.shrunk(image, LARGEST, LARGEST)
    height, width = image.shape[:2]
    factor = max(ENLARGED // max(height, width), 1)
    size = width * factor, height * factor
    panel = max(size[0], 100)  # wide enough for the text
    even = lambda n: n + n % 2  # as videos want it
    canvas = Image.new("RGB", (even(2 * panel + 3 * MARGIN), even(size[1] + MARGIN + TEXT)), "#16191d")
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.truetype(str(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")), 13)
    for i, (shown, label) in enumerate(
        ((image, f"step {step}"), (resample(np.nan_to_num(target), (height, width)), goal))
    ):
        left = MARGIN + i * (panel + MARGIN)
        pixels = Image.fromarray(pictures.to_srgb(shown)).resize(size, Image.Resampling.NEAREST)
        canvas.paste(pixels, (left + (panel - size[0]) // 2, MARGIN))
        draw.text((left, MARGIN + size[1] + 5), label, fill="#dde3ea", font=font)
    return canvas


def _write_video(path: Path, frames: Sequence[Image.Image], program: str) -> Path:
    width, height = frames[0].size
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(FPS), "-i", "-"]
    coding = ["-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    data = b"".join(frame.tobytes() for frame in [*frames, *[frames[-1]] * HOLD])
    with replacing(path) as temporary:
        command = [program, "-y", "-loglevel", "error", *source, *coding, str(temporary)]
        subprocess.run(command, input=data, capture_output=True, check=True, timeout=120)
    return path


def _write_gif(path: Path, frames: Sequence[Image.Image]) -> Path:
    """All frames share the colours of the first, the middle and the last one, undithered: smaller, and no flicker."""
    chosen = [frames[i] for i in (0, len(frames) // 2, -1)]
    width, height = frames[0].size
    together = Image.new("RGB", (width, height * len(chosen)))
    for i, frame in enumerate(chosen):
        together.paste(frame, (0, i * height))
    palette = together.quantize(255)
    shown = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    while True:
        file = io.BytesIO()
        durations = [1000 // FPS] * (len(shown) - 1) + [1000 * HOLD // FPS]
        shown[0].save(file, "GIF", save_all=True, append_images=shown[1:], duration=durations, loop=0)
        if file.tell() <= MOST or len(shown) < 8:
            break
        shown = [*shown[:-1:2], shown[-1]]
    with replacing(path) as temporary:
        temporary.write_bytes(file.getvalue())
    return path


def goal(result: Result) -> str:
    """What the target shows. What a loss that compares nothing looks at has none: it is shown beside its beginning."""
    return "target" if result.problem.compares else "scene as it was"
