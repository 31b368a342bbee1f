"""The shipped scenes load, render, and are what their names say."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from rimlight import scenes


def test_names_and_paths():
    assert scenes.names() == [
        *("coloured_cube", "cube", "glossy_receiver", "lit_room", "mirrored_plane", "objects", "shadow_blocker"),
        *("textured_gloss", "two_triangles"),
    ]
    with pytest.raises(ValueError, match=r'no scene "teapot", choose one of coloured_cube'):
        scenes.path("teapot")


@pytest.mark.parametrize("name", scenes.names())
def test_scene_renders(name):
    scene = mi.load_file(str(scenes.path(name)), res=24)
    image = np.array(mi.render(scene, spp=16))
    assert image.shape == (24, 24, 3)
    assert np.isfinite(image).all()
    assert image.std() > 0.02
    path = {"type": "path", "max_depth": scene.integrator().depths.max_depth}
    reference = np.array(mi.render(scene, integrator=mi.load_dict(path), spp=256))
    np.testing.assert_allclose(image.mean((0, 1)), reference.mean((0, 1)), rtol=0.05)


def test_default_resolution_and_filter():
    for name in scenes.names():
        film = mi.load_file(str(scenes.path(name))).sensors()[0].film()
        assert tuple(film.size()) == (64, 64)
        assert film.rfilter().is_box_filter()


def test_faces_of_the_coloured_cube_are_those_of_a_cube():
    """Every rectangle faces outwards, and the picture shows three colours."""
    scene = mi.load_file(str(scenes.path("coloured_cube")))
    for shape in scene.shapes():
        frame = mi.traverse(shape)["to_world"]
        centre, normal = frame @ mi.Point3f(0), frame @ mi.Normal3f(0, 0, 1)
        np.testing.assert_allclose(np.array(centre), np.array(normal), atol=1e-6)
    image = np.array(mi.render(scene, spp=4)).reshape(-1, 3)
    colours = {tuple(np.round(pixel, 2)) for pixel in image if (np.abs(image - pixel).max(1) < 1e-3).sum() > 40}
    assert len(colours) == 4  # and black


def test_two_triangles_are_the_published_ones(shared):
    import json

    data = json.loads(shared("scenes/redner.json").read_text())["scenes"]["two_triangles"]
    params = mi.traverse(mi.load_file(str(scenes.path("two_triangles"))))
    for name, shape in zip(("green", "red"), data["shapes"], strict=False):
        vertices = np.array(params[f"{name}.vertex_positions"]).reshape(-1, 3)
        np.testing.assert_allclose(vertices, shape["vertices_target"], atol=1e-6)
        reflectance = np.array(params[f"{name}.bsdf.reflectance.value"]).ravel()
        np.testing.assert_allclose(reflectance, data["materials"][shape["material"]]["reflectance"], atol=1e-6)
