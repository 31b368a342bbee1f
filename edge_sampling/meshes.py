"""Access to the geometry of a scene. The only module that knows how Mitsuba stores a mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .curves import CURVES


@dataclass(frozen=True)
class Geometry:
    """The shapes of a scene, sorted by what can be done with them.

    meshes : triangle meshes (also `rectangle`, `cube` and merged shapes), whose edges are known.
    analytic : spheres, disks, cylinders, whose outlines are known curves.
    others : all else (instances, hair, ...). They occlude and receive light, but must not move.
    """

    meshes: tuple[Any, ...]
    analytic: tuple[Any, ...] = ()
    others: tuple[Any, ...] = ()

    @staticmethod
    def of(scene: mi.Scene) -> Geometry:
        shapes = scene.shapes()
        meshes = tuple(s for s in shapes if s.is_mesh() and s.class_name() != "EllipsoidsMesh")
        analytic = tuple(s for s in shapes if s.class_name() in CURVES)
        return Geometry(meshes, analytic, tuple(s for s in shapes if s not in meshes and s not in analytic))

    def key(self) -> tuple[tuple[int, int, int], ...]:
        """What must stay the same for the edges found earlier to be valid: which meshes there are, and their sizes."""
        meshes = tuple((int(m.ptr), m.vertex_count(), m.face_count()) for m in self.meshes)
        return meshes + tuple((int(s.ptr), 0, 0) for s in self.analytic)

    def faces(self, wanted: tuple[bool, ...]) -> np.ndarray:
        """Faces of the meshes that are `wanted`: (F, 3), indices into `positions`, on the host."""
        offsets = np.cumsum([0, *(m.vertex_count() for m in self.meshes)])
        chosen = [faces(m) + np.uint32(o) for m, o, w in zip(self.meshes, offsets, wanted, strict=False) if w]
        return np.concatenate(chosen) if chosen else np.zeros((0, 3), np.uint32)

    def moving(self) -> tuple[bool, ...]:
        """For every mesh, and then for every analytic shape: does it move?"""
        meshes = tuple(dr.grad_enabled(m.vertex_positions_buffer()) for m in self.meshes)
        return meshes + tuple(dr.grad_enabled(mi.traverse(s)["to_world"]) for s in self.analytic)

    def refuse_moving_others(self, scene: mi.Scene, who: str) -> None:
        """Refuse derivatives with respect to shapes whose silhouettes are not known, inside of shape groups, too.

        Raises
        ------
        RuntimeError : one of `others`, or a shape in a group, carries a gradient in one of its own parameters.
        """
        known = {int(s.ptr) for s in (*self.meshes, *self.analytic)}
        params = mi.traverse(scene)
        for key, (_, _, node, _) in params.properties.items():
            if isinstance(node, mi.Shape) and int(node.ptr) not in known and dr.grad_enabled(params[key]):
                raise RuntimeError(
                    f'{who}: shape "{node.id()}" ({node.class_name()}) moves ("{key}" carries a gradient), but its '
                    "silhouettes cannot be sampled: only triangle meshes, spheres, disks and cylinders outside of "
                    "shape groups can move. Replace it by such a mesh, or detach it."
                )

    def positions(self) -> mi.Float:
        """Vertex positions of all meshes, one after the other: (3 V,), world space, scene units; attached."""
        return _concat([m.vertex_positions_buffer() for m in self.meshes])

    def host_positions(self) -> np.ndarray:
        """Vertex positions of all meshes: (V, 3), world space, on the host."""
        return np.concatenate([vertices(m) for m in self.meshes]) if self.meshes else np.zeros((0, 3), np.float32)

    def normals(self) -> mi.Float:
        """Vertex normals of all meshes, laid out as `positions`; zero where a mesh has none. Detached."""
        return _concat(
            [
                dr.detach(m.vertex_normals_buffer())
                if has_interpolated_normals(m)
                else dr.zeros(mi.Float, 3 * m.vertex_count())
                for m in self.meshes
            ]
        )


def faces(mesh: Any) -> np.ndarray:
    """Vertex indices of the triangles of a mesh: (F, 3), uint32, on the host."""
    return np.array(mesh.faces_buffer()).reshape(-1, 3)


def vertices(mesh: Any) -> np.ndarray:
    """Vertex positions of a mesh: (V, 3), world space, on the host, detached."""
    return np.array(dr.detach(mesh.vertex_positions_buffer())).reshape(-1, 3)


def texture_coordinates(mesh: Any) -> np.ndarray | None:
    """Texture coordinates of a mesh: (V, 2) on the host, or None."""
    return np.array(dr.detach(mesh.vertex_texcoords_buffer())).reshape(-1, 2) if mesh.has_vertex_texcoords() else None


def has_interpolated_normals(mesh: Any) -> bool:
    return mesh.has_vertex_normals() and not mesh.has_face_normals()


def has_face_attributes(mesh: Any) -> bool:
    """Does the mesh carry attributes that are constant on a face, and so jump at each of its edges?"""
    return any(k.startswith("face_") for k, _ in mi.traverse(mesh).items())


def _concat(buffers: list[mi.Float]) -> mi.Float:
    if not buffers:
        return dr.zeros(mi.Float, 3)
    return buffers[0] if len(buffers) == 1 else dr.concat(buffers)


def jumping_textures(scene: mi.Scene) -> list[str]:
    """Names of the textures whose value jumps inside of a face: checkerboards, bitmaps with the `nearest` filter."""
    return [f'"{t.id()}" ({t.class_name()})' for t in _objects(scene) if isinstance(t, mi.Texture) and _jumps(t)]


def _objects(root: mi.Object) -> list[Any]:
    """All objects below `root`, each once."""
    found: list[Any] = []

    class Children(mi.TraversalCallback):
        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object) and value not in found:
                found.append(value)

        put_value = put_object = put

    found.append(root)
    for obj in found:  # grows as it goes
        obj.traverse(Children())
    return found


def _jumps(texture: Any, pairs: int = 256, steps: int = 18) -> bool:
    """Bisect random segments towards their steeper half: where a texture is continuous, the difference dies out."""
    if not texture.is_spatially_varying() or not texture.class_name().startswith(("Bitmap", "Checkerboard")):
        return False
    with dr.suspend_grad():
        rng = mi.PCG32(size=pairs)
        si = dr.zeros(mi.SurfaceInteraction3f, pairs)
        if mi.is_spectral:
            si.wavelengths = type(si.wavelengths)(550)

        def value(uv: mi.Point2f) -> mi.Spectrum:
            si.uv = uv
            return texture.eval(si)

        difference = lambda f, g: dr.max(dr.abs(f - g))
        p, q = mi.Point2f(rng.next_float32(), rng.next_float32()), mi.Point2f(rng.next_float32(), rng.next_float32())
        at_p, at_q = value(p), value(q)
        before = difference(at_p, at_q)
        for _ in range(steps):
            middle = 0.5 * (p + q)
            at_middle = value(middle)
            left = difference(at_p, at_middle) > difference(at_middle, at_q)
            p, at_p = dr.select(left, p, middle), dr.select(left, at_p, at_middle)
            q, at_q = dr.select(left, middle, q), dr.select(left, at_middle, at_q)
        return bool(dr.any((before > 0) & (difference(at_p, at_q) > 0.3 * before)))
