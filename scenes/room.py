"""A room full of things, seen by a fisheye camera: for a fit of 177 parameters, as figure 1 of Li et al. 2018.

    python -m rimlight.scenes.room FOLDER

writes `room.xml`, and `room.toml`, the fit: 6 parameters of the pose of the camera, 165 of the materials of 42 objects
(29 are diffuse, 13 shiny), and 6 of two lights. Shapes and colours come from random numbers with a fixed seed.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

#: Half-extents of the room along x and z, and its height.
WIDTH, HEIGHT, DEPTH = 3.0, 2.8, 2.5

#: Boxes on the floor, things on top of some, and boards on the walls. With the walls, floor and ceiling they are
#: 42 objects, of which these many are shiny.
BOXES, THINGS, BOARDS, SHINY = 16, 12, 8, 13

#: Between things that seem to stand on each other: where they touch, derivatives of interreflections are noisy.
GAP = 0.02


@dataclass(frozen=True)
class Thing:
    """shape : plugin. transform : XML. shiny : has it a highlight? diffuse, specular : reflectances, RGB."""

    name: str
    shape: str
    transform: str
    shiny: bool
    diffuse: tuple[float, ...]
    specular: tuple[float, ...]

    @property
    def keys(self) -> list[str]:
        """Its free parameters."""
        if not self.shiny:
            return [f"{self.name}.bsdf.reflectance.value"]
        return [f"{self.name}.bsdf.{part}_reflectance.value" for part in ("diffuse", "specular")]

    def xml(self) -> str:
        rgb = lambda name, value: f'<rgb name="{name}" value="{", ".join(f"{v:.3f}" for v in value)}"/>'
        if self.shiny:
            parts = rgb("diffuse_reflectance", self.diffuse) + rgb("specular_reflectance", self.specular)
            bsdf = f'<bsdf type="blinn_phong">{parts}<float name="roughness" value="0.15"/></bsdf>'
        else:
            bsdf = f'<bsdf type="diffuse">{rgb("reflectance", self.diffuse)}</bsdf>'
        return (
            f'    <shape type="{self.shape}" id="{self.name}">\n'
            f'        <transform name="to_world">{self.transform}</transform>\n        {bsdf}\n    </shape>\n'
        )


def things() -> list[Thing]:
    """All objects but the lights."""
    rng = np.random.default_rng(2018)
    names_and_places = [*_walls(), *_furniture(rng)]
    shiny = set(rng.choice(np.arange(6, len(names_and_places)), SHINY, replace=False).tolist())
    found = []
    for i, (name, shape, transform) in enumerate(names_and_places):
        diffuse = rng.uniform(0.5, 0.8, 3) if i < 6 else rng.uniform(0.15, 0.75, 3)
        if i in shiny:
            diffuse = diffuse * 0.6
        specular = np.full(3, rng.uniform(0.1, 0.35))
        found.append(Thing(name, shape, transform, i in shiny, tuple(diffuse), tuple(specular)))
    return found


def _walls() -> Iterator[tuple[str, str, str]]:
    wall = lambda name, scale, turn, to: (
        name,
        "rectangle",
        f'<scale x="{scale[0]:g}" y="{scale[1]:g}"/>{turn}<translate x="{to[0]:g}" y="{to[1]:g}" z="{to[2]:g}"/>',
    )
    turn = lambda axis, angle: f'<rotate {axis}="1" angle="{angle}"/>'
    middle = HEIGHT / 2
    yield wall("floor", (WIDTH, DEPTH), turn("x", -90), (0, 0, 0))
    yield wall("ceiling", (WIDTH, DEPTH), turn("x", 90), (0, HEIGHT, 0))
    yield wall("back", (WIDTH, middle), turn("y", 180), (0, middle, DEPTH))
    yield wall("front", (WIDTH, middle), "", (0, middle, -DEPTH))
    yield wall("left", (DEPTH, middle), turn("y", 90), (-WIDTH, middle, 0))
    yield wall("right", (DEPTH, middle), turn("y", -90), (WIDTH, middle, 0))


def _furniture(rng: np.random.Generator) -> Iterator[tuple[str, str, str]]:
    """Boxes in a grid of places, smaller ones on top of them, and boards on the walls, none of which touch."""
    box = lambda name, size, angle, centre: (
        name,
        "cube",
        f'<scale x="{size[0]:.3f}" y="{size[1]:.3f}" z="{size[2]:.3f}"/><rotate y="1" angle="{angle:.1f}"/>'
        f'<translate x="{centre[0]:.3f}" y="{centre[1]:.3f}" z="{centre[2]:.3f}"/>',
    )
    columns, rows = 4, BOXES // 4
    tops = []
    for i in range(BOXES):
        x = (i % columns - (columns - 1) / 2) * 2 * WIDTH / (columns + 0.4)
        z = -0.9 + (i // columns) * (DEPTH + 0.5) / rows
        half = np.array([rng.uniform(0.18, 0.32), rng.uniform(0.15, 0.45), rng.uniform(0.15, 0.22)])
        centre = np.array([x + rng.uniform(-0.12, 0.12), half[1] + GAP, z])
        angle = rng.uniform(-15, 15)
        yield box(f"box{i:02d}", half, angle, centre)
        tops.append((centre, half, angle))
    for i in range(THINGS):
        centre, half, angle = tops[i]
        size = rng.uniform(0.07, 0.13, 3)
        on_top = centre + np.array([rng.uniform(-0.04, 0.04), half[1] + GAP + size[1], 0])
        yield box(f"thing{i:02d}", size, angle + rng.uniform(-30, 30), on_top)
    for i in range(BOARDS):
        size = np.array([rng.uniform(0.3, 0.45), rng.uniform(0.2, 0.35), 0.03])
        y = rng.uniform(1.5, 2.0)
        along = (i // 3 - 0.8) * 1.5
        if i % 3 == 0:
            yield box(f"board{i}", size, 0, (along * 1.2, y, DEPTH - GAP - size[2]))
        else:
            side = 1 if i % 3 == 1 else -1
            yield box(f"board{i}", size, 90, (side * (WIDTH - GAP - size[2]), y, along))


LIGHTS = {
    "window": ('<scale x="0.5" y="0.4"/><rotate x="1" angle="90"/><translate x="-1.4" y="2.7" z="0.6"/>', (9, 10, 12)),
    "lamp": ('<scale x="0.3" y="0.3"/><rotate x="1" angle="90"/><translate x="1.3" y="2.6" z="-0.4"/>', (16, 13, 8)),
}

#: Resolution, steps, factor of the rates at the begin, and at the end of that.
STAGES = ((64, 150, 1.0, 0.4), (128, 150, 0.4, 0.25), (256, 300, 0.1, 0.03))

HEAD = """<!-- Made by rimlight.scenes.room -->
<scene version="3.0.0">
    <default name="res" value="512"/>

    <integrator type="prb_edge"><integer name="max_depth" value="5"/></integrator>

    <sensor type="fisheye" id="camera">
        <float name="fov" value="170"/>
        <transform name="to_world"><lookat origin="0.2, 1.5, -2.1" target="0, 1.1, 1" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="$res"/>
            <integer name="height" value="$res"/>
            <rfilter type="box"/>
        </film>
    </sensor>
"""


def scene() -> str:
    """The scene file."""
    lights = [
        f'    <shape type="rectangle" id="{name}">\n        <transform name="to_world">{transform}</transform>\n'
        f'        <bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>\n'
        f'        <emitter type="area"><rgb name="radiance" value="{", ".join(map(str, radiance))}"/></emitter>\n'
        "    </shape>\n"
        for name, (transform, radiance) in LIGHTS.items()
    ]
    return "\n".join([HEAD, *(thing.xml() for thing in things()), *lights, "</scene>\n"])


def fit() -> str:
    """The problem, for `rimlight fit`: from grey materials and another pose, in stages of 64², 128² and 256² pixels.

    Lights count in the loss: what they emit times what walls reflect is much better known than either.
    """
    diffuse = [key for thing in things() for key in thing.keys if "specular" not in key]
    specular = [key for thing in things() for key in thing.keys if "specular" in key]
    keys = lambda names: "[\n" + "".join(f'    "{name}",\n' for name in names) + "]"
    entry = lambda names, kind, rate, start: (
        f'[[free]]\nkey = {keys(names)}\nkind = "{kind}"\nrate = {rate}\nstart = {start}\n'
    )
    stages = [
        f"[[stage]]\nresolution = {resolution}\niterations = {iterations}\nrate = {rate}\ndecay = {decay}\n"
        for resolution, iterations, rate, decay in STAGES
    ]
    return "\n".join(
        [
            "# Made by rimlight.scenes.room",
            'scene = "room.xml"',
            'define = { res = "256" }',
            'integrator = { type = "prb_edge", max_depth = 5 }',
            "clip = 1.5\n",
            "[[target]]\nspp = 512\n",
            '[[free]]\nkey = "camera.to_world"\nkind = "pose"\nrate = 0.02\nturn_rate = 0.01',
            "start = [0.15, -0.1, 0.12, 4, -5, 3]\n",
            entry(diffuse, "material", 0.03, [0.5]),
            entry(specular, "material", 0.03, [0.2]),
            entry([f"{name}.emitter.radiance.value" for name in LIGHTS], "light", 0.3, [8]),
            '[loss]\nnorm = "l1"\npyramid = 5\n',
            *stages,
        ]
    )


def write(folder: Path) -> Path:
    """Write scene and fit. Returns the file of the fit."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "room.xml").write_text(scene(), "utf-8")
    (folder / "room.toml").write_text(fit(), "utf-8")
    return folder / "room.toml"


if __name__ == "__main__":
    print(write(Path(sys.argv[1])))
