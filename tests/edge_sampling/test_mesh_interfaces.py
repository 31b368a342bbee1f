"""Meshes are read alike through the interfaces of Mitsuba 3.9 and 3.10, of which the latter is a stand-in here."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from rimlight.checks import Motion
from rimlight.edge_sampling import Geometry, find_edges
from rimlight.edge_sampling.geometry import meshes
from rimlight.inverse import Free, free_parameters, smooth_mesh


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


@pytest.mark.parametrize(
    ("key", "present", "expected"),
    [
        ("cube.vertex_positions", "cube.positions", "cube.positions"),
        ("cube.positions", "cube.vertex_positions", "cube.vertex_positions"),
        ("vertex_normals", "normals", "normals"),
        ("cube.vertex_positions", "ball.positions", "cube.vertex_positions"),
        ("cube.vertex_color", "cube.color", "cube.vertex_color"),
        ("cube.positions", "cube.positions", "cube.positions"),
    ],
)
def test_scenes_of_one_interface_name_the_parameters_of_the_other(key, present, expected):
    assert meshes.present_key({present: None}, key) == expected


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


# ---------------------- Fits, and meshes that are made ----------------------


class Parameters(dict):
    """Those of one corner-sharing cube, as Mitsuba 3.10 names them, or 3.9."""

    def __init__(self, new: bool):
        mesh = mi.load_dict({"type": "cube"})
        cube = Tensors(mesh)
        if new:
            super().__init__({"a.positions": cube.positions(), "a.faces": cube.faces()})
            self["a.position_index"] = cube.position_index()
        else:
            super().__init__({"a.vertex_positions": mesh.vertex_positions_buffer(), "a.faces": mesh.faces_buffer()})


def at_vertices(params: Parameters, value) -> np.ndarray:
    """(V, 3), of a parameter of positions."""
    rows = np.array(value).reshape(-1, 3)
    return rows[np.array(params["a.position_index"])] if "a.position_index" in params else rows


@pytest.mark.parametrize(
    "how", [{"kind": "pose", "start": (0.1, 0, 0.2, 0, 30, 0)}, {"kind": "shape", "start": (0.1, 0, 0.2)}], ids=str
)
def test_fits_move_both_alike(variant, how):
    """The same vertices to the same places, with the same gradients."""
    found = []
    for params in (Parameters(new=False), Parameters(new=True)):
        key = meshes.positions_key(params)
        (parameter,) = free_parameters.find([Free(key=(key,), **how)], params)
        latents = {name: mi.Float(start) for name, start in parameter.start.items()}
        dr.enable_grad(latents)
        value = parameter.values(latents)[key]
        assert type(value) is type(params[key])
        assert dr.shape(value) == dr.shape(params[key])
        points = meshes.points(value)
        if "a.position_index" in params:
            points = dr.gather(mi.Point3f, dr.ravel(points), params["a.position_index"])
        dr.backward(dr.sum(dr.squared_norm(points)))
        found.append((at_vertices(params, value), *(np.array(dr.grad(x)) for x in latents.values())))
    for old, new in zip(*found, strict=True):
        np.testing.assert_allclose(new, old, rtol=1e-4, atol=1e-5)


def test_triangles_are_the_same(variant):
    old, new = (
        np.array(params[key]).reshape(-1, 3)[meshes.faces_of_positions(params, key)]
        for params, key in ((Parameters(new=False), "a.vertex_positions"), (Parameters(new=True), "a.positions"))
    )
    np.testing.assert_array_equal(new, old)


def test_smoothing_pulls_both_alike(variant):
    params = Parameters(new=True)
    key = "a.positions"
    faces = meshes.faces_of_positions(params, key)
    as_tensor = smooth_mesh(key, faces, 2.0)({key: params[key]})
    as_flat = smooth_mesh(key, faces, 2.0)({key: params[key].array})
    assert as_tensor[0] == as_flat[0] > 0


def test_meshes_are_made_in_both(variant, monkeypatch):
    """Vertices, normals and attributes arrive: in the mesh of this Mitsuba, and at the calls of 3.10's."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float64)
    faces = np.array([[0, 1, 2]])
    normals = np.array([[0, 0.6, 0.8]] * 3)
    colour = np.linspace(0, 1, 9).reshape(3, 3)
    given = {"normals": normals, "attributes": {"vertex_color": colour}}
    old = meshes.make_mesh("a", vertices, faces, bsdf=mi.load_dict({"type": "conductor"}), **given)
    assert old.bsdf().class_name() == "SmoothConductor"
    np.testing.assert_allclose(np.array(old.vertex_normals_buffer()).reshape(3, 3), normals, rtol=1e-6)
    np.testing.assert_allclose(np.array(old.attribute_buffer("vertex_color")), colour.ravel(), rtol=1e-6)

    class New:
        def __init__(self, props):
            self.name, self.made, self.attributes = props.id(), None, {}

        def from_fields(self, faces, positions, normals):
            self.fields = faces, positions, normals

        def add_attribute(self, name, values):
            self.attributes[name] = values

        def recompute_normals(self):
            self.made = True

    monkeypatch.setattr(mi, "Mesh", New)
    new = meshes.make_mesh("a", vertices, faces, **given)
    assert (new.name, new.made) == ("a", None)
    for tensor, expected in zip(
        (*new.fields, *new.attributes.values()), (faces, vertices, normals, colour), strict=True
    ):
        assert tensor.shape == expected.shape
        np.testing.assert_allclose(np.array(tensor), expected, rtol=1e-6)
    assert meshes.make_mesh("a", vertices, faces).made
