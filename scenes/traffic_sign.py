"""A stop sign by a road, for an adversarial scene, as figure 10 of Li et al. 2018.

    python -m rimlight.scenes.traffic_sign FOLDER

writes `traffic_sign.xml`, the fit `traffic_sign.toml`, `sign.ply` and `sign.png`. Free are 2208 numbers: the pose
of the camera (6), the radiance of the sky (3), irradiance (3) and direction (3) of the sun, the pose of the sign (6),
and its 729 vertices. The fit makes a network see a traffic light in the sign. It needs `rimlight[adversarial]`.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

#: Circumradius of the sign, metres, and its rings of vertices.
RADIUS, RINGS = 0.45, 13

#: Height of its centre above the ground, metres.
HEIGHT = 2.1

#: Between things that seem to stand on each other, metres: meshes must not cut through each other.
GAP = 0.01

#: Of the texture, pixels; it is drawn four times as large.
TEXTURE = 256


def octagon() -> tuple[np.ndarray, np.ndarray]:
    """Concentric rings of triangles in the plane z = 0, which face +z.

    Returns
    -------
    vertices : (729, 3); the ring k has 8 k of them. faces : (1352, 3).
    """
    corners = [np.array([math.cos(a), math.sin(a), 0]) for a in (np.arange(9) + 0.5) * math.pi / 4]
    vertices, faces = [np.zeros(3)], []
    first = [0, *(1 + 4 * k * (k - 1) for k in range(1, RINGS + 1))]
    at = lambda ring, i: first[ring] + i % max(8 * ring, 1)
    for k in range(1, RINGS + 1):
        for side in range(8):
            for i in range(k):
                t = i / k
                vertices.append(RADIUS * k / RINGS * ((1 - t) * corners[side] + t * corners[side + 1]))
                outer, inner = side * k + i, side * (k - 1) + i
                faces.append((at(k - 1, inner), at(k, outer), at(k, outer + 1)))
                if i < k - 1:
                    faces.append((at(k - 1, inner), at(k, outer + 1), at(k - 1, inner + 1)))
    return np.array(vertices), np.array(faces)


def mesh() -> str:
    """The sign in its place, with texture coordinates: PLY."""
    vertices, faces = octagon()
    uv = vertices[:, :2] / (2 * RADIUS) * [1, -1] + 0.5  # the first row of a picture is v = 0
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    head += [f"property float {name}" for name in ("x", "y", "z", "u", "v")]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    place = np.array([0, HEIGHT, 0])
    points = [" ".join(f"{x:.6f}" for x in (*p, *t)) for p, t in zip(vertices + place, uv, strict=True)]
    return "\n".join([*head, *points, *(f"3 {a} {b} {c}" for a, b, c in faces), ""])


def texture() -> Image.Image:
    """White letters on a red octagon with a white border."""
    size = 4 * TEXTURE
    image = Image.new("RGB", (size, size), "#e8e8e4")
    draw = ImageDraw.Draw(image)
    angles = (np.arange(8) + 0.5) * math.pi / 4
    draw.polygon(
        [(size / 2 * (1 + 0.93 * math.cos(a)), size / 2 * (1 + 0.93 * math.sin(a))) for a in angles], "#b01e23"
    )
    # Bold letters of matplotlib's own font, made narrower, as on signs.
    font = ImageFont.truetype(str(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans-Bold.ttf")), size // 3)
    left, top, right, bottom = font.getbbox("STOP")
    letters = Image.new("L", (right - left, bottom - top))
    ImageDraw.Draw(letters).text((-left, -top), "STOP", 255, font)
    letters = letters.resize((round(0.74 * size), round(0.31 * size)), Image.Resampling.LANCZOS)
    image.paste("#e8e8e4", ((size - letters.width) // 2, (size - letters.height) // 2), letters)
    return image.resize((TEXTURE, TEXTURE), Image.Resampling.LANCZOS)


# ------------------------------------------------------------------ files


def _diffuse(colour: str) -> str:
    return f'<bsdf type="diffuse"><rgb name="reflectance" value="{colour}"/></bsdf>'


def _shape(kind: str, name: str, transform: str, colour: str) -> str:
    return (
        f'    <shape type="{kind}" id="{name}">\n        <transform name="to_world">{transform}</transform>\n'
        f"        {_diffuse(colour)}\n    </shape>\n"
    )


def _box(
    name: str, half: tuple[float, float, float], foot: tuple[float, float, float], colour: str, turn: float = 0
) -> str:
    """A box that stands `GAP` above its foot."""
    x, y, z = foot
    return _shape(
        "cube",
        name,
        f'<scale x="{half[0]:g}" y="{half[1]:g}" z="{half[2]:g}"/><rotate y="1" angle="{turn:g}"/>'
        f'<translate x="{x:g}" y="{y + half[1] + GAP:g}" z="{z:g}"/>',
        colour,
    )


def _flat(name: str, half: tuple[float, float], centre: tuple[float, float, float], colour: str) -> str:
    return _shape(
        "rectangle",
        name,
        f'<scale x="{half[0]:g}" y="{half[1]:g}"/><rotate x="1" angle="-90"/>'
        f'<translate x="{centre[0]:g}" y="{centre[1]:g}" z="{centre[2]:g}"/>',
        colour,
    )


def _hill(name: str, radius: float, centre: tuple[float, float, float], colour: str) -> str:
    x, y, z = centre
    return _shape("sphere", name, f'<scale value="{radius:g}"/><translate x="{x:g}" y="{y:g}" z="{z:g}"/>', colour)


HEAD = f"""<!-- Made by rimlight.scenes.traffic_sign -->
<scene version="3.0.0">
    <default name="res" value="224"/>

    <integrator type="direct_edge"/>

    <sensor type="perspective" id="camera">
        <float name="fov" value="37"/>
        <transform name="to_world">
            <lookat origin="1.1, 1.25, 2.15" target="-0.28, 1.87, 0" up="0, 1, 0"/>
        </transform>
        <sampler type="multijitter"/>
        <film type="hdrfilm">
            <integer name="width" value="$res"/>
            <integer name="height" value="$res"/>
            <rfilter type="box"/>
        </film>
    </sensor>

    <emitter type="constant" id="sky">
        <rgb name="radiance" value="0.42, 0.5, 0.78"/>
    </emitter>
    <emitter type="directional" id="sun">
        <transform name="to_world"><lookat origin="-1.8, 3.4, 2.8" target="0, 0, 0" up="0, 1, 0"/></transform>
        <rgb name="irradiance" value="2, 2.05, 1.7"/>
    </emitter>

    <shape type="ply" id="sign">
        <string name="filename" value="sign.ply"/>
        <bsdf type="twosided">
            <bsdf type="diffuse">
                <texture type="bitmap" name="reflectance">
                    <string name="filename" value="sign.png"/>
                    <string name="wrap_mode" value="clamp"/>
                </texture>
            </bsdf>
            {_diffuse("0.4, 0.4, 0.4")}
        </bsdf>
    </shape>
"""


def scene() -> str:
    """The scene file."""
    post = HEIGHT + 0.8 * RADIUS
    things = [
        _box("post", (0.03, post / 2, 0.02), (0, 0, -0.06), "0.35, 0.36, 0.36"),
        _flat("grass", (300, 300), (0, 0, -250), "0.13, 0.2, 0.06"),
        _flat("road", (60, 3), (0, 0.02, -8), "0.16, 0.16, 0.17"),
        _flat("stripe", (60, 0.07), (0, 0.04, -8), "0.7, 0.68, 0.6"),
        _box("house", (3.2, 1.6, 2.5), (-7.5, 0, -22), "0.62, 0.55, 0.45", 12),
        _box("roof", (3.5, 0.3, 2.8), (-7.5, 3.25, -22), "0.32, 0.14, 0.1", 12),
    ]
    for i, (x, z, r) in enumerate([(-170, -130, 70), (-95, -150, 60), (10, -190, 80)]):
        things.append(_hill(f"hill{i}", r, (x, 12 - r, z), "0.14, 0.22, 0.12"))
    return "\n".join([HEAD, *things, "</scene>\n"])


FIT = """# Made by rimlight.scenes.traffic_sign
scene = "traffic_sign.xml"
integrator = { type = "direct_edge" }

[loss]
norm = "classifier"
rise = { "traffic light" = 920 }
fall = { "street sign" = 919 }

[[target]]
spp = 64

[[free]]
key = "camera.to_world"
kind = "pose"
rate = 0.002
turn_rate = 0.0005

[[free]]
key = ["sky.radiance.value", "sun.irradiance.value"]
kind = "light"
rate = 0.0015

[[free]]
key = "sun.to_world"
kind = "pose"
move = ""
turn_rate = 0.004

[[free]]
key = "sign.vertex_positions"
kind = "shape"
rate = 0.0003

[[free]]
key = "sign.vertex_positions"                   # the displaced sign, as a whole
kind = "pose"
rate = 0.001
turn_rate = 0.002

[[stage]]
iterations = 120
decay = 0.5
"""


def write(folder: Path) -> Path:
    """Write scene, mesh, texture and fit. Returns the file of the fit."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sign.ply").write_text(mesh(), "ascii")
    texture().save(folder / "sign.png")
    (folder / "traffic_sign.xml").write_text(scene(), "utf-8")
    (folder / "traffic_sign.toml").write_text(FIT, "utf-8")
    return folder / "traffic_sign.toml"


if __name__ == "__main__":
    print(write(Path(sys.argv[1])))
