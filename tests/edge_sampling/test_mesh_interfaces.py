"""Meshes are read alike through the interfaces of Mitsuba 3.9 and 3.10, of which the latter is a stand-in here."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight.checks import Motion
from rimlight.edge_sampling import Geometry, find_edges
from rimlight.edge_sampling.geometry import meshes


class Tensors:
    """A mesh with the interface of Mitsuba 3.10: tensors, and positions and normals that vertices share."""

    def __init__(self, mesh: mi.Mesh):
        self.mesh = mesh
        rows = lambda buffer, columns: np.array(buffer, np.float32).reshape(-1, columns)
        self._positions, self._position_index = self._shared(rows(mesh.vertex_positions_buffer(), 3))
        self._normals, self._normal_index = mi.TensorXf(), mi.UInt32()
        if mesh.has_vertex_normals():
            self._normals, self._normal_index = self._shared(rows(mesh.vertex_normals_buffer(), 3))
        self._texcoords = mi.TensorXf(rows(mesh.vertex_texcoords_buffer(), 2))

    @staticmethod
    def _shared(rows: np.ndarray) -> tuple[mi.TensorXf, mi.UInt32]:
        different, index = np.unique(rows, axis=0, return_inverse=True)
        if len(different) == len(rows):
            return mi.TensorXf(rows), mi.UInt32()
        return mi.TensorXf(different), mi.UInt32(index.ravel().astype(np.uint32))

    def positions(self) -> mi.TensorXf:
        return self._positions

    def position_index(self) -> mi.UInt32:
        return self._position_index

    def normals(self) -> mi.TensorXf:
        return self._normals

    def normal_index(self) -> mi.UInt32:
        return self._normal_index

    def texcoords(self) -> mi.TensorXf:
        return self._texcoords

    def faces(self) -> mi.TensorXu:
        return mi.TensorXu(np.array(self.mesh.faces_buffer()).reshape(-1, 3))

    def attribute(self, name: str) -> mi.TensorXf:
        count = self.face_count() if name.startswith("face_") else self.vertex_count()
        return mi.TensorXf(np.array(self.mesh.attribute_buffer(name)).reshape(count, -1))

    def has_normals(self) -> bool:
        return self.mesh.has_vertex_normals()

    def has_texcoords(self) -> bool:
        return self.mesh.has_vertex_texcoords()

    def __getattr__(self, name: str):
        """What is the same in both."""
        if name in (
            "vertex_count",
            "face_count",
            "has_face_normals",
            "id",
            "ptr",
            "bsdf",
            "class_name",
            "is_mesh",
            "traverse",
        ):
            return getattr(self.mesh, name)
        raise AttributeError(name)


def with_colours(mesh: mi.Mesh) -> mi.Mesh:
    mesh.add_attribute("vertex_color", 3, np.linspace(0, 1, 3 * mesh.vertex_count(), dtype=np.float32))
    return mesh


MESHES = {
    "cube": lambda: mi.load_dict({"type": "cube"}),
    "flat shaded cube": lambda: mi.load_dict({"type": "cube", "face_normals": True}),
    "coloured rectangle": lambda: with_colours(mi.load_dict({"type": "rectangle"})),
}


@pytest.mark.parametrize("name", MESHES)
def test_arrays_are_the_same(variant, name, monkeypatch):
    old = MESHES[name]()
    new = Tensors(old)
    traverse = mi.traverse
    monkeypatch.setattr(mi, "traverse", lambda o: traverse(o.mesh if isinstance(o, Tensors) else o))
    for read in (meshes.faces, meshes.vertices, meshes.texture_coordinates, meshes.vertex_values):
        np.testing.assert_array_equal(read(new), read(old))
    assert meshes.is_smooth(new) == meshes.is_smooth(old)
    assert meshes.has_interpolated_normals(new) == meshes.has_interpolated_normals(old)
    assert meshes.vertex_attributes(new).keys() == meshes.vertex_attributes(old).keys()
    a, b = Geometry((new,)), Geometry((old,))
    np.testing.assert_array_equal(np.array(a.positions()), np.array(b.positions()))
    np.testing.assert_array_equal(np.array(a.normals()), np.array(b.normals()))
    np.testing.assert_array_equal(a.faces((True,)), b.faces((True,)))


def test_vertices_of_the_cube_share_positions(variant):
    """Else the test above would say little."""
    cube = Tensors(mi.load_dict({"type": "cube"}))
    assert cube.positions().shape == (8, 3) and cube.vertex_count() == 24
    assert cube.normals().shape == (6, 3)


def test_edges_are_the_same(variant):
    old = mi.load_dict({"type": "cube"})
    edges = [find_edges(Geometry((m,))) for m in (old, Tensors(old))]
    np.testing.assert_array_equal(edges[0].vertices, edges[1].vertices)


def test_gradients_of_shared_positions_add_up(variant):
    """A position of a corner of the cube belongs to three vertices."""
    cube = Tensors(mi.load_dict({"type": "cube"}))
    geometry = Geometry((cube,))
    assert geometry.moving() == (False,)
    dr.enable_grad(cube.positions())
    assert geometry.moving() == (True,)
    dr.backward(dr.sum(geometry.positions()))
    np.testing.assert_array_equal(np.array(dr.grad(cube.positions())), np.full((8, 3), 3, np.float32))


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("cube.vertex_positions", True),
        ("cube.positions", True),
        ("positions", True),
        ("lamp.positions_of_leds", False),
        ("cube.faces", False),
    ],
)
def test_keys_of_positions(key, expected):
    assert meshes.is_positions_key(key) is expected


def test_motions_of_tensors_are_those_of_flat_arrays(variant, monkeypatch):
    """`rimlight check` and its like: the same vertices move by the same vector."""

    class Parameters(dict):
        def update(self) -> None:
            pass

    rows = np.arange(12, dtype=np.float32).reshape(4, 3)
    moved = {}
    for key, value in (("a.vertex_positions", mi.Float(rows.ravel())), ("a.positions", mi.TensorXf(rows))):
        parameters = Parameters({key: value})
        monkeypatch.setattr(mi, "traverse", lambda _, p=parameters: p)
        motion = Motion(None, key, rotate=[0, 0, 1], vertices=[1, 3])
        assert motion.unit == "radian"
        motion.apply(0.5)
        assert type(motion.params[key]) is type(value)
        moved[key] = np.array(motion.params[key]).reshape(4, 3)
    np.testing.assert_array_equal(*moved.values())
    np.testing.assert_array_equal((moved["a.positions"] != rows).any(1), [False, True, False, True])
