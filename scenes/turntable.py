"""A crate on a floor, seen by 24 cameras around it: where it stands, and what is painted on it, shall be found.

    python -m rimlight.scenes.turntable FOLDER

writes `turntable.xml`, `paint.png` and the fit `turntable.toml`. Free are the pose of the crate (6 numbers) and its
texture (49,152). The texture begins grey, and the crate 0.18 units and 12 degrees off. What is painted moves with the
crate: its outlines alone tell where it stands.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

#: Cameras, on two rings; and texels in a row.
CAMERAS, TEXELS = 24, 128

#: Free parameters.
CRATE, PAINT = "crate.vertex_positions", "crate.bsdf.reflectance.data"


def paint() -> Image.Image:
    """Rings and stripes of several colours."""
    y, x = (np.mgrid[:TEXELS, :TEXELS] + 0.5) / TEXELS
    rings = np.hypot(x - 0.35, y - 0.4) * 9 % 1 < 0.5
    stripes = (x + 2 * y) * 6 % 1 < 0.3
    colours = np.stack([0.25 + 0.6 * rings, 0.2 + 0.5 * x, 0.75 - 0.5 * stripes], 2)
    return Image.fromarray(np.uint8(255 * np.clip(colours, 0, 1)))


def _camera(number: int) -> str:
    angle = 2 * np.pi * number / CAMERAS
    place = f"{5 * np.cos(angle):.4f}, {(2.2, 3.4)[number % 2]}, {5 * np.sin(angle):.4f}"
    return f"""    <sensor type="perspective" id="camera{number}">
        <float name="fov" value="32"/>
        <transform name="to_world"><lookat origin="{place}" target="0, 0.8, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="$res"/> <integer name="height" value="$res"/> <rfilter type="box"/>
        </film>
    </sensor>
"""


SCENE = """<!-- Made by rimlight.scenes.turntable -->
<scene version="3.0.0">
    <default name="res" value="512"/>
    <integrator type="direct_edge"/>
{cameras}
    <emitter type="constant"><rgb name="radiance" value="0.6, 0.65, 0.7"/></emitter>
    <shape type="rectangle" id="lamp">
        <transform name="to_world">
            <scale value="1.2"/> <rotate x="1" angle="90"/> <translate x="2" y="6" z="1"/>
        </transform>
        <emitter type="area"><rgb name="radiance" value="6, 5.5, 5"/></emitter>
    </shape>
    <shape type="cube" id="crate">
        <transform name="to_world"><scale value="0.8"/><rotate y="1" angle="25"/><translate y="0.82"/></transform>
        <bsdf type="diffuse">
            <texture type="bitmap" name="reflectance">
                <string name="filename" value="paint.png"/> <boolean name="raw" value="true"/>
                <string name="format" value="variant"/>
            </texture>
        </bsdf>
    </shape>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.35, 0.33, 0.3"/></bsdf>
    </shape>
</scene>
"""

FIT = f"""# Made by rimlight.scenes.turntable
scene = "turntable.xml"
integrator = {{ type = "direct_edge" }}
views_per_step = 6

[[free]]
key = "{CRATE}"
kind = "pose"
start = [0.15, 0, -0.1, 0, 12, 0]
rate = 0.01
turn_rate = 0.01

[[free]]
key = "{PAINT}"
kind = "material"
start = [0.5]
rate = 0.02

[[stage]]
resolution = 128
iterations = 150

[[stage]]
resolution = 256
iterations = 100
rate = 0.5

[[stage]]
iterations = 40
rate = 0.3
decay = 0.1
"""


def write(folder: Path | str) -> Path:
    """Write scene, texture and fit into a folder. Returns the path of the fit."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paint().save(folder / "paint.png")
    (folder / "turntable.xml").write_text(SCENE.format(cameras="".join(map(_camera, range(CAMERAS)))), "utf-8")
    targets = "".join(f"\n[[target]]\nsensor = {i}\nspp = 64\n" for i in range(CAMERAS))
    (folder / "turntable.toml").write_text(FIT + targets, "utf-8")
    return folder / "turntable.toml"


if __name__ == "__main__":
    print(write(sys.argv[1]))
