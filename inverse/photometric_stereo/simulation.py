"""Data sets with a known truth: height fields, path traced under all lights at once (`rig`)."""

from __future__ import annotations

import dataclasses
import difflib
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage
from tqdm import tqdm

from rimlight import ggx, no_collection
from rimlight.edge_sampling.geometry.meshes import as_parameter, make_mesh, positions_key
from rimlight.edge_sampling.refusals import InputError
from rimlight.exr import write_exr
from rimlight.leds import Led, emitters
from rimlight.loading import one_line

from . import dataset
from .dataset import Dataset
from .integration import mesh_of, normals_of
from .vectors import spiral, unit

#: File of the true depth.
TRUE_DEPTH = "Depth_gt.exr"

#: Vertices per side of a pixel. Odd: one lies at its centre.
DETAIL = 3

#: Width of the object over that of the image.
FILLED = 0.88

#: Standard deviation of the Gaussian that makes regions of noise, over the width of the image.
REGION = 0.08

#: Roughness (alpha of GGX) and index of refraction of a glaze.
GLAZE = 0.08, 1.5

#: Samples, times lights, of one launch: between launches, a progress bar can move.
LAUNCH = 2**23


@dataclass(frozen=True, kw_only=True)
class Options:
    """What the object is, and how it is rendered.

    Raises
    ------
    ValueError : an option is out of its range.
    """

    shape: str = "sphere"
    """"sphere", "bowl", "folds" (a dome with folds, which differ from seed to seed), or the file of a mesh,
    .obj or .ply, which is seen from its +z with y up."""
    concave: bool = False
    """Mirror the surface in depth, which makes a mould of it."""
    hollow: float = 0.32
    """Depth of a bowl over its width. 0.5 is a hemisphere."""
    rotate: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Turn a mesh about x, then y, then z, degrees."""
    crop: tuple[float, float, float, float, float] = (0.0, 0.0, 1.0, 1.0, 0.0)
    """Part of a mesh that is shown: left, bottom, right, top and back, over its turned bounding box."""
    smooth: float = 0.5
    """Smooth the depth of a mesh: standard deviation of a Gaussian, pixels."""
    bsdf: str = "diffuse:0.5,0.5,0.5"
    """"diffuse:R,G,B"; "glaze:R,G,B", that colour under a clear coat; a table of the MERL database, .binary; lobes and
    weights of a `ggx_dictionary`, .json; or the name of one of its materials. Several with | between them: regions of
    equal areas, which differ from seed to seed."""
    lights: int = 96
    """Number of lights."""
    spread: float = 55.0
    """Largest angle between a light and the direction to the camera, degrees."""
    led_distance: float = 0.0
    """Distance of LEDs from the middle of the object, over the width of the image. Needs --focal. 0: distant lights."""
    focal: float = 0.0
    """Focal length of the camera, over the width of the image. 0: an orthographic camera."""
    size: int = 128
    """Width and height of the images, pixels."""
    max_depth: int = 5
    """Longest path: 2 is direct light, 3 adds one interreflection."""
    spp: int = 64
    """Samples per pixel."""
    noise: float = 0.0
    """Standard deviation of the noise, over the median value."""
    seed: int = 0
    """Random seed."""

    def __post_init__(self):
        left, bottom, right, top, back = self.crop
        checks = {
            "hollow": 0 < self.hollow <= 0.5,
            "crop": 0 <= left < right <= 1 and 0 <= bottom < top <= 1 and 0 <= back < 1,
            "smooth": 0 <= self.smooth < np.inf,
            "lights": self.lights >= 3,
            "spread": 0 < self.spread < 90,
            "led_distance": self.led_distance == 0 or (self.led_distance >= 1 and self.focal > 0),
            "focal": self.focal == 0 or self.focal >= 1,
            "size": self.size >= 8,
            "max_depth": 2 <= self.max_depth <= 16,
            "spp": self.spp >= 1,
            "noise": 0 <= self.noise < np.inf,
            "seed": self.seed >= 0,
        }
        for name, right in checks.items():
            if not right:
                raise InputError(f'ps: "{name}" is out of its range, got {getattr(self, name)}')


@dataclass(frozen=True)
class HeightField:
    """A surface in object space: `DETAIL` x `DETAIL` vertices for each of N x N squares of side 1, whose middle is the
    origin.

    depth : (D N, D N), z; NaN beside the object. normals : (D N, D N, 3).
    """

    depth: np.ndarray
    normals: np.ndarray

    def mesh(self, bsdf: mi.BSDF, offset: np.ndarray, attributes: dict[str, np.ndarray] | None = None) -> mi.Mesh:
        """attributes : of the vertices, (D N, D N) each."""
        inside = np.isfinite(self.depth)
        vertices, faces, _ = mesh_of(self.depth, inside, pixel_size=1 / DETAIL)
        middle = (self.depth.shape[0] - 1) / 2 / DETAIL
        place = vertices + np.array([-middle, middle, 0]) + offset
        mesh = make_mesh("object", place, faces, normals=self.normals[inside], bsdf=bsdf)
        for name, values in (attributes or {}).items():
            mesh.add_attribute(name, 1, values[inside].astype(np.float32))
        return mesh


def simulate(options: Options, *, progress: bool = True) -> tuple[Dataset, np.ndarray]:
    """Render a data set.

    Returns
    -------
    data : with the true normals, the mean ones of each pixel.
    depth : (N, N), at the centres of pixels, as `integrate` has it; NaN outside the mask. In pixels of the plane in
        which the object begins.

    Raises
    ------
    ValueError : the mesh or the BSDF cannot be read; the surface covers no pixel. FileNotFoundError.
    """
    N = options.size
    middle = (N - 1) / 2
    camera = None
    origin = np.array([middle, -middle, 0.0])
    if options.focal:
        f = options.focal * N
        camera, origin = np.array([[f, 0, middle], [0, f, middle], [0, 0, 1]]), np.array([0, 0, -f])
    surface = height_field(options)
    mesh = surface.mesh(*_materials(options, origin, np.isfinite(surface.depth)))
    directions = spiral(options.lights, options.spread)
    lights, intensities = directions, np.ones((options.lights, 3))
    if options.led_distance:
        R = options.led_distance * N
        lights = tuple(
            Led(tuple((origin + R * d).tolist()), tuple((-d).tolist()), 1.0, (1.0, 1.0, 1.0)) for d in directions
        )
        intensities *= R * R
    scene = mi.load_dict({"type": "scene", "object": mesh, "sensor": _sensor(N, camera), **_emitters(lights)})
    mask, normals, depth = _truth(scene, N, camera)
    if not mask.any():
        raise InputError("ps: the surface covers no pixel; make the images larger")
    images = _render(scene, options, progress)
    values = images.reshape(N, N, -1, 3)[mask]
    if options.noise:
        rng = np.random.default_rng(options.seed)
        values += np.float32(options.noise * np.median(values)) * rng.standard_normal(values.shape, np.float32)
    distance = None if camera is None else float(np.exp(np.log(depth[mask]).mean()))
    data = Dataset(values, mask, lights, intensities, camera, normals[mask], distance=distance)
    return data, np.where(mask, depth, np.nan)


def write(folder: Path, data: Dataset, depth: np.ndarray, options: Options) -> None:
    """Write a folder that `dataset.read` reads, and the true depth, `Depth_gt.exr`.

    Raises
    ------
    OSError
    """
    dataset.write(folder, data)
    header = {key: str(value) for key, value in dataclasses.asdict(options).items()}
    write_exr(
        folder / TRUE_DEPTH, {"": np.nan_to_num(depth)[..., None]}, {"unit": "pixels where the object begins", **header}
    )


# ---------------------- Shapes ----------------------


def height_field(options: Options) -> HeightField:
    """The surface, and its normals as far as formulas tell them; of a mesh and of folds, they are those of its depth.

    Raises
    ------
    ValueError : the mesh cannot be read, or cannot be seen. FileNotFoundError.
    """
    N = options.size
    at = (np.arange(DETAIL * N) - (DETAIL - 1) / 2) / DETAIL - (N - 1) / 2
    x, y = np.meshgrid(at, -at)
    a = FILLED * N / 2
    if options.shape == "sphere":
        field = _sphere(x, y, a, a)
    elif options.shape == "bowl":
        field = _sphere(x, y, a, 2 * a * options.hollow)
        field = _mirrored(field)
    elif options.shape == "folds":
        field = _folds(x, y, a, np.random.default_rng(options.seed))
    else:
        field = _of_mesh(x, y, 2 * a, options)
    return _mirrored(field) if options.concave else field


def _sphere(x: np.ndarray, y: np.ndarray, width: float, height: float) -> HeightField:
    """Cap of a sphere. width : radius of its border."""
    R = (width**2 + height**2) / (2 * height)
    inside = x * x + y * y < width * width
    n = np.stack([x, y, np.sqrt(np.maximum(R * R - x * x - y * y, 0))], -1) / R
    return HeightField(np.where(inside, R * n[..., 2] - (R - height), np.nan), n)


def _folds(x: np.ndarray, y: np.ndarray, width: float, rng: np.random.Generator) -> HeightField:
    """A dome with folds, as of a cloth: waves that bend. width : radius of its border."""
    u, v = x / width, y / width
    turn, first, second, bend = rng.uniform(0, 2 * np.pi, 4)
    u, v = u * np.cos(turn) + v * np.sin(turn), v * np.cos(turn) - u * np.sin(turn)
    u = u + 0.15 * np.sin(2.3 * v + bend)
    waves = 0.09 * np.cos(4 * np.pi * u + first) + 0.04 * np.cos(2 * np.pi * (1.1 * u + 1.7 * v) + second)
    inside = x**2 + y**2 < width**2
    dome = 0.7 * np.sqrt(np.maximum(1 - 0.8 * (x**2 + y**2) / width**2, 0))
    depth = np.where(inside, width * (dome + waves), np.nan)
    depth -= np.nanmean(depth)
    return HeightField(depth, normals_of(depth, inside, pixel_size=1 / DETAIL))


def _mirrored(field: HeightField) -> HeightField:
    return HeightField(-field.depth, field.normals * [-1, -1, 1])


def _of_mesh(x: np.ndarray, y: np.ndarray, size: float, options: Options) -> HeightField:
    """What the camera sees of a mesh: the highest point at each place."""
    path = Path(options.shape)
    if path.suffix.lower() not in (".obj", ".ply"):
        raise InputError(f'ps: unknown shape "{path}", expected sphere, bowl, folds, or a file .obj or .ply')
    if not path.is_file():
        raise FileNotFoundError(f'ps: there is no file "{path}"')
    mesh = _load({"type": path.suffix[1:].lower(), "filename": str(path), "face_normals": True})
    params = mi.traverse(mesh)
    key = positions_key(params)
    vertices = np.array(params[key], np.float64).reshape(-1, 3) @ _rotation(options.rotate).T
    if not mesh.face_count() or not np.isfinite(vertices).all():
        raise InputError(f'ps: "{path}" has no faces, or vertices that are not finite')
    low, extent = vertices.min(0), np.ptp(vertices, 0)
    left, bottom, right, top, back = options.crop
    first, last = low + extent * [left, bottom, back], low + extent * [right, top, 1]
    scale = size / (last - first)[:2].max()
    params[key] = as_parameter((vertices - (first + last) / 2) * scale, params[key])
    params.update()
    scene = mi.load_dict({"type": "scene", "mesh": mesh})
    far = float(scale * extent[2])
    origin = mi.Point3f(*(mi.Float(np.float32(c.ravel())) for c in (x, y)), far)
    found = scene.ray_intersect_preliminary(mi.Ray3f(origin, mi.Vector3f(0, 0, -1)))
    depth = far - np.array(found.t, np.float64).reshape(x.shape)
    half = (last - first) / 2 * scale
    depth[(np.abs(x) > half[0]) | (np.abs(y) > half[1]) | ~(np.abs(depth) <= half[2])] = np.nan
    # Every point needs neighbours, for its normal
    inside = ndimage.binary_opening(np.isfinite(depth), np.ones((2, 2)))
    if not inside.any():
        raise InputError(f'ps: the camera sees nothing of "{path.name}"; turn it, or show more of it')
    depth[~inside] = np.nan
    if options.smooth:
        blur = lambda a: ndimage.gaussian_filter(a, options.smooth * DETAIL)
        depth = np.where(inside, blur(np.nan_to_num(depth)) / np.maximum(blur(inside.astype(float)), 1e-9), np.nan)
    depth -= np.nanmean(depth)
    return HeightField(depth, normals_of(depth, inside, pixel_size=1 / DETAIL))


def _rotation(degrees: tuple[float, float, float]) -> np.ndarray:
    T = mi.ScalarTransform4f
    x, y, z = degrees
    turned = T().rotate([0, 0, 1], z) @ T().rotate([0, 1, 0], y) @ T().rotate([1, 0, 0], x)
    return np.array(turned.matrix)[:3, :3]


# ---------------------- Rendering ----------------------


def _materials(options: Options, origin: np.ndarray, inside: np.ndarray) -> tuple[mi.BSDF, np.ndarray, dict]:
    """What `HeightField.mesh` needs: the BSDF, blended from several by attributes of the vertices, and these.

    inside : (D N, D N), bool, where the surface is.
    """
    found, *others = (bsdf(text) for text in options.bsdf.split("|"))
    rng, attributes = np.random.default_rng([options.seed, 1]), {}
    noise = ndimage.gaussian_filter(rng.standard_normal(inside.shape), REGION * len(inside))
    borders = np.quantile(noise[inside], np.arange(1, len(others) + 1) / (len(others) + 1))
    for k, (other, border) in enumerate(zip(others, borders, strict=True)):
        attributes[f"vertex_region{k}"] = noise > border
        weight = {"type": "mesh_attribute", "name": f"vertex_region{k}"}
        found = mi.load_dict({"type": "blendbsdf", "weight": weight, "first": found, "second": other})
    return found, origin, attributes


def bsdf(text: str) -> mi.BSDF:
    """What a part of `Options.bsdf` means.

    Raises
    ------
    ValueError : it means nothing, or the file cannot be read. FileNotFoundError.
    """
    kind, colon, rest = text.partition(":")
    if colon and kind in ("diffuse", "glaze"):
        try:
            colour = [float(c) for c in rest.split(",")]
        except ValueError:
            colour = []
        if len(colour) != 3 or not all(0 <= c <= 1 for c in colour):
            raise InputError(f'ps: expected "{kind}:R,G,B", from 0 to 1, got "{text}"')
        if kind == "glaze":
            return _glaze(colour)
        return mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}})
    plugin = {".binary": "merl", ".json": "ggx_dictionary"}.get(Path(text).suffix.lower())
    if plugin is None:
        _, materials = ggx.read_dictionary()
        if text not in materials:
            close = difflib.get_close_matches(text, materials, n=1)
            hint = f', did you mean "{close[0]}"?' if close else "; a file must end in .binary or .json"
            raise InputError(f'ps: unknown BSDF "{text}"{hint}')
        return mi.load_dict({"type": "ggx_dictionary", "material": text})
    if not Path(text).is_file():
        raise FileNotFoundError(f'ps: there is no file "{text}"')
    return _load({"type": plugin, "filename": text})


def _glaze(colour: list[float]) -> mi.BSDF:
    alpha, eta = GLAZE
    return mi.load_dict(
        {
            "type": "ggx_dictionary",
            "alpha": mi.Float(alpha),
            "eta": mi.Float(eta),
            "weights": mi.TensorXf([1.0], shape=(1, 1)),
            "base": {"type": "rgb", "value": colour},
            "base_eta": eta,
        }
    )


def _load(description: dict) -> mi.Object:
    try:
        return mi.load_dict(description)
    except RuntimeError as error:
        raise InputError(f'ps: cannot read "{description["filename"]}": {one_line(error)}') from None


def _sensor(N: int, camera: np.ndarray | None) -> dict:
    film = {"type": "hdrfilm", "width": N, "height": N, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    T, middle = mi.ScalarTransform4f(), (N - 1) / 2
    if camera is None:
        far = 4 * N  # no surface is so deep
        look = T.look_at(origin=[middle, -middle, far], target=[middle, -middle, 0], up=[0, 1, 0])
        to_world = look @ T.scale([N / 2, N / 2, 1])
        return {"type": "orthographic", "to_world": to_world, "near_clip": 1, "far_clip": 2 * far, "film": film}
    fov = float(np.degrees(2 * np.arctan(N / 2 / camera[0, 0])))
    to_world = T.look_at(origin=[0, 0, 0], target=[0, 0, -1], up=[0, 1, 0])
    return {"type": "perspective", "fov": fov, "to_world": to_world, "near_clip": 1e-2, "film": film}


def _emitters(lights: np.ndarray | tuple[Led, ...]) -> dict:
    if isinstance(lights, tuple):
        return emitters(lights)
    return {"lights": {"type": "distant_lights", "directions": mi.TensorXf(lights.astype(np.float32))}}


@no_collection()
def _truth(scene: mi.Scene, N: int, camera: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels that the surface covers, and a little more: (N, N). Mean normals of pixels, (N, N, 3). Depth, (N, N)."""
    at = (np.arange(DETAIL * N) - (DETAIL - 1) / 2) / DETAIL
    u, v = (mi.Float(np.float32(c.ravel())) for c in np.meshgrid(at, at))
    if camera is None:
        ray = mi.Ray3f(mi.Point3f(u, -v, 4 * N), mi.Vector3f(0, 0, -1))
    else:
        middle, f = (N - 1) / 2, float(camera[0, 0])
        ray = mi.Ray3f(mi.Point3f(0), dr.normalize(mi.Vector3f((u - middle) / f, (middle - v) / f, -1)))
    si = scene.ray_intersect(ray)
    n = si.sh_frame.n
    seen = np.array(si.is_valid() & (dr.dot(n, ray.d) < 0)).reshape(DETAIL * N, DETAIL * N)
    centres = slice(DETAIL // 2, None, DETAIL)
    mask = ndimage.binary_erosion(seen, np.ones((DETAIL + 2, DETAIL + 2)))[centres, centres]
    normals = unit(np.array(n, np.float64).T.reshape(N, DETAIL, N, DETAIL, 3).mean((1, 3)))
    depth = np.array(si.p.z, np.float64).reshape(seen.shape)[centres, centres]
    return mask, normals, depth if camera is None else -depth


def _render(scene: mi.Scene, options: Options, progress: bool) -> np.ndarray:
    """(N, N, 3 K), radiance for irradiances, or intensities, of 1."""
    N, K = options.size, options.lights
    integrator = mi.load_dict({"type": "rig", "max_depth": options.max_depth, "rr_depth": 99})
    most = max(LAUNCH // (N * N * K), 1)
    launches = [min(most, options.spp - done) for done in range(0, options.spp, most)]
    total = np.zeros((N, N, 3 * K), np.float32)
    with tqdm(total=options.spp, desc="spp", disable=not progress) as bar:
        for k, spp in enumerate(launches):
            total += np.array(integrator.render(scene, seed=options.seed + k, spp=spp)) * np.float32(spp / options.spp)
            bar.update(spp)
    return total
