"""What is found must be what `mi.traverse` finds, since users set parameters by that."""

import cases
import drjit as dr
import mitsuba as mi
import pytest

from rimlight.edge_sampling.geometry.parameters import parameters


@pytest.mark.parametrize("name", ["two_triangles_green", "textured_cube_side", "surroundings_turn", "sphere_soft"])
def test_as_mitsuba_traverses(name):
    scene = cases.case(name).scene()
    found, expected = {p.name: p for p in parameters(scene)}, mi.traverse(scene)
    assert found.keys() == expected.properties.keys()
    for name, (_, _, node, _) in expected.properties.items():
        assert found[name].node is node
        assert dr.all(found[name].value == expected[name], axis=None)
