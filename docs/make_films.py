"""Films of fits for the documentation:  python docs/make_films.py FIGURES

FIGURES is the folder that `rimlight reproduce all --out FIGURES` has written. Of each fit, its convergence.gif is
thinned and written as docs/images/films/NAME.webp, of at most LARGEST bytes.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

from PIL import Image, ImageSequence

FOLDER = Path(__file__).parent / "images" / "films"

#: Bytes of a film, and its pictures at most, whatever their size.
LARGEST, MOST = 300_000, 40

#: Milliseconds that a picture stays, and the last one.
SHOWN, LAST = 120, 2000


def film(gif: Path) -> bytes:
    """Every second, third, … picture of a film, and its last one, as WebP."""
    with Image.open(gif) as source:
        frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(source)]
    quality, step = 70, max(1, len(frames) // MOST)
    while True:
        # More often in the beginning, where most happens
        chosen = [*frames[: 8 * step : max(1, step // 2)], *frames[8 * step : -1 : step], frames[-1]]
        file = io.BytesIO()
        durations = [SHOWN] * (len(chosen) - 1) + [LAST]
        chosen[0].save(
            file, "WEBP", save_all=True, append_images=chosen[1:], duration=durations, loop=0, quality=quality, method=6
        )
        if file.tell() <= LARGEST or len(chosen) < 8:
            return file.getvalue()
        step += 1


def main(figures: Path) -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    for gif in sorted(figures.rglob("convergence.gif")):
        name = gif.relative_to(figures).parts[0]
        data = film(gif)
        (FOLDER / f"{name}.webp").write_bytes(data)
        print(f"{name}: {len(data):,} bytes")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
