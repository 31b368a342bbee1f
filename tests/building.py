"""What the scenes of the tests are built of."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

RES = 32


def film(rfilter: str = "box", **options: Any) -> dict:
    return {
        "type": "hdrfilm",
        "width": RES,
        "height": RES,
        "rfilter": {"type": rfilter},
        "pixel_format": "rgb",
        **options,
    }


def camera(origin=(1.5, 2, -5), target=(0, 0, 0), kind="perspective", film=None, **options: Any) -> dict:
    T = mi.ScalarTransform4f
    to_world = T().look_at(list(origin), list(target), [0, 1, 0])
    if kind == "orthographic":
        to_world = to_world @ T().scale([2, 2, 1])
    else:
        options = {"fov": 45, **options}
    return {"type": kind, "to_world": to_world, "film": film or globals()["film"](), **options}


def diffuse(*value: float, two_sided: bool = False) -> dict:
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(value) if len(value) == 3 else value[0]}}
    return {"type": "twosided", "bsdf": bsdf} if two_sided else bsdf


def light(*radiance: float) -> dict:
    return {"type": "area", "radiance": {"type": "rgb", "value": list(radiance)}}


def mesh(name: str, vertices, faces, normals: bool = False, uv=None, colours=None, **props: Any) -> mi.Mesh:
    """A mesh from lists; flat-shaded unless `normals`. `uv` and `colours` (`vertex_color`) are given by vertex."""
    p = mi.Properties()
    for key, value in props.items():
        p[key] = mi.load_dict(value) if isinstance(value, dict) else value
    has_uv = uv is not None
    m = mi.Mesh(name, len(vertices), len(faces), has_vertex_normals=normals, has_vertex_texcoords=has_uv, props=p)
    if colours is not None:
        m.add_attribute("vertex_color", 3, np.float32(colours).ravel())
    params = mi.traverse(m)
    params["vertex_positions"] = np.float32(vertices).ravel()
    params["faces"] = np.uint32(faces).ravel()
    if has_uv:
        params["vertex_texcoords"] = np.float32(uv).ravel()
    params.update()
    m.set_id(name)
    return m


CUBE_FACES = [
    [0, 2, 1],
    [1, 2, 3],
    [4, 5, 6],
    [5, 7, 6],
    [0, 1, 4],
    [1, 5, 4],
    [2, 6, 3],
    [3, 6, 7],
    [0, 4, 2],
    [2, 4, 6],
    [1, 3, 5],
    [3, 7, 5],
]


def cube_vertices() -> np.ndarray:
    """Eight corners of a turned cube of half-side 1."""
    corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    turn = mi.ScalarTransform4f().rotate([0, 1, 0.3], 30)
    return np.array([list(turn @ mi.ScalarPoint3f(*c)) for c in corners])


def scene(**objects: Any) -> mi.Scene:
    return mi.load_dict({"type": "scene", **objects})


def constant(radiance: float = 1.0) -> dict:
    return {"type": "constant", "radiance": {"type": "rgb", "value": radiance}}


def quad(origin, u, v, name: str, **props: dict) -> mi.Mesh:
    """Parallelogram of corner `origin` and sides u, v; its front is where u × v points."""
    o, u, v = np.array(origin, float), np.array(u, float), np.array(v, float)
    return mesh(name, [o, o + u, o + v, o + u + v], [[0, 1, 2], [1, 3, 2]], **props)


def horizontal(centre, half: float, name: str, down: bool = False, **props: dict) -> mi.Mesh:
    """Square of half-side `half`."""
    x, z = [2 * half, 0, 0], [0, 0, 2 * half]
    return quad(np.add(centre, [-half, 0, -half]), *((x, z) if down else (z, x)), name, **props)
