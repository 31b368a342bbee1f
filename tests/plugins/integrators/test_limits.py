"""What derivatives lack is said: in the log, once, and in the plan."""

from __future__ import annotations

import as_written
import cases
import drjit as dr
import grids
import mitsuba as mi
import numpy as np
import pytest
import sliding_textures
import wires
from random_scenes import ball

import rimlight
from rimlight._plan import listed
from rimlight.edge_sampling.boundaries.fine_mirrors import mean_fringe
from rimlight.edge_sampling.geometry import texture_lines

FOG = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 0.5}


def said(scene, *keys: str, kind: str = "direct_edge", derivative: bool = False, **options) -> list[str]:
    """Warnings of a derivative with respect to some parameters, made twice by one integrator; or of its search for
    boundaries, which says the same and compiles little."""
    params, integrator = mi.traverse(scene), mi.load_dict({"type": kind, **options})
    for key in keys:
        value = params[key]
        dr.enable_grad(value)
        params[key] = value
    params.update()
    with cases.messages() as messages:
        for seed in range(2):
            if derivative:
                image = mi.render(scene, params, integrator=integrator, spp=1, seed=seed)
                dr.backward(dr.sum(image, axis=None))
            else:
                integrator.find_boundaries(scene)
    messages = [m for m in messages if f"{kind}: " in m]
    limits = integrator.plan(scene).limits
    assert [m.split(f"{kind}: ", 1)[1] for m in messages] == list(limits)
    return messages


# ---------------------- Shapes in the same place ----------------------


def twice(kind: str, apart: float):
    """Two things of a kind, and a sheet whose vertices are in another order."""
    sheet = ([-1, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0])
    place = lambda k: mi.ScalarTransform4f().translate([k * apart, 0, 0])
    if kind == "mesh":
        orders = [[0, 1, 2, 3], [2, 0, 3, 1]]
        of = lambda k: cases.mesh(f"thing_{k}", np.array(sheet)[orders[k]] + [k * apart, 0, 0], [[0, 1, 2], [1, 3, 2]])
    else:
        of = lambda k: {"type": kind, "id": f"thing_{k}", "to_world": place(k)}
    camera = cases.camera((0, 0, -5), (0, 0, 0))
    return cases.scene(sensor=camera, thing_0=of(0), thing_1=of(1), sky=cases.constant())


@pytest.mark.parametrize("kind", ["sphere", "disk", "cylinder", "mesh"])
@pytest.mark.parametrize("apart", [0, 0.01])
def test_shapes_in_the_same_place_are_warned_about(kind, apart):
    key = "thing_0.vertex_positions" if kind == "mesh" else "thing_0.to_world"
    found = [m for m in said(twice(kind, apart), key) if "in the same place" in m]
    assert len(found) == (apart == 0)
    assert all('"thing_0" and "thing_1". Delete' in m for m in found)


@pytest.mark.parametrize("height", [0, 0.01])
def test_a_sheet_in_the_plane_of_a_floor_is_warned_about(height):
    floor = cases.horizontal((0, 0, 0), 2, "floor", bsdf=cases.diffuse(0.5))
    sheet = cases.horizontal((0.5, height, 0.3), 1, "sheet", bsdf=cases.diffuse(0.8))
    built = cases.scene(sensor=cases.camera((0, 2, -5), (0, 0, 0)), floor=floor, sheet=sheet, sky=cases.constant())
    found = [m for m in said(built, "sheet.vertex_positions") if "overlap in one plane" in m]
    assert len(found) == (height == 0)
    assert all('"floor" and "sheet". Move' in m for m in found)


# ---------------------- Scenes of many shapes ----------------------


def test_long_lists_of_names_are_cut_short():
    assert listed(["a", "b"]) == "a, b"
    assert listed("abcdef") == "a, b, c, d, e, f"
    assert listed("abcdefgh") == "a, b, c, d, e, and 3 more"


def test_many_coarse_lamps_are_one_warning_and_plans_log_nothing():
    points, _, _, faces = ball(4)
    names = [f"lamp_{i}" for i in range(8)]
    at = lambda i: np.array([3 * i, 0, 0])
    mesh = lambda i, name: cases.mesh(name, points + at(i), faces, normals=True, emitter=cases.light(1, 1, 1))
    lamps = {name: mesh(i, name) for i, name in enumerate(names)}
    scene = cases.scene(sensor=cases.camera((0, 0, -9), (0, 0, 0)), **lamps)
    with cases.messages() as messages:
        plan = rimlight.plan(scene, ["lamp_0.vertex_positions"], integrator=mi.load_dict({"type": "prb_edge"}))
    (limit,) = [text for text in plan.limits if "coarse meshes" in text]
    assert '"lamp_4", and 3 more falls' in limit and "e+" not in limit
    assert not [m for m in messages if "prb_edge: " in m]


# ---------------------- The far clipping plane ----------------------


def to_the_horizon(far: float):
    floor = cases.horizontal((0, -1, 0), 20, "floor", bsdf=cases.diffuse(0.5, two_sided=True))
    thing = {"type": "sphere", "id": "thing", "radius": 0.5}
    camera = cases.camera((0, 0, -5), (0, 0, 0), far_clip=far)
    return cases.scene(sensor=camera, floor=floor, thing=thing, sky=cases.constant())


@pytest.mark.parametrize("key", ["floor.vertex_positions", "sensor.to_world"])
def test_cuts_of_the_far_plane_are_warned_about(key):
    (message,) = said(to_the_horizon(15.0), key)
    assert 'the far clipping plane of "sensor" through "floor"; increase its far_clip, now 15' in message


@pytest.mark.parametrize(
    ("far", "key"),
    [(15.0, "thing.to_world"), (15.0, "floor.bsdf.brdf_0.reflectance.value"), (50.0, "sensor.to_world")],
)
def test_no_cut_of_the_far_plane_that_matters(far, key):
    assert not said(to_the_horizon(far), key)


# ---------------------- The near clipping plane ----------------------


@pytest.mark.parametrize("kind", ["sphere", "disk", "cylinder"])
@pytest.mark.parametrize("key", ["thing.to_world", "sensor.to_world"])
def test_cuts_of_the_near_plane_are_no_limit(kind, key):
    assert not said(cases.near_shape(kind)(), key)


def test_far_plane_of_each_sensor():
    """The limits are those of the sensor that looks."""
    scene = to_the_horizon(15.0)
    other = mi.load_dict(cases.camera((0, 0, -5), (0, 0, 0), far_clip=50.0))
    params, integrator = mi.traverse(scene), mi.load_dict({"type": "direct_edge"})
    dr.enable_grad(params["floor.vertex_positions"])
    params.update()
    assert [len(integrator.plan(scene, sensor).limits) for sensor in (other, scene.sensors()[0], other)] == [0, 1, 0]


# ---------------------- Maps on a GPU ----------------------


@pytest.fixture
def in_steps(monkeypatch):
    """Bitmaps are looked up as the texture units of a GPU do it: places are rounded to 1/256 of a texel."""
    exact = texture_lines.texture_value

    def rounded(texture, at):
        size = np.array(texture.resolution(), float)
        return exact(texture, mi.Point2f(*(dr.round(x * n * 256) / (n * 256) for x, n in zip(at, size, strict=True))))

    monkeypatch.setattr(texture_lines, "texture_value", rounded)


def mapped_board(kind: str, name: str, inner: dict):
    texels = np.random.default_rng(0).uniform(0.4, 0.6, (5, 7, 3)).astype(np.float32)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "accel": False}
    board = cases.horizontal((0, 0, 0), 1, "board", bsdf={"type": kind, name: bitmap, "inner": inner})
    cube = {"type": "cube", "id": "cube", "to_world": mi.ScalarTransform4f().translate([0, 1, 0]).scale(0.2)}
    return cases.scene(sensor=cases.camera((0, 3, -3), (0, 0, 0)), board=board, cube=cube, sky=cases.constant())


MAPS = pytest.mark.parametrize(("kind", "name"), [("bumpmap", "heights"), ("normalmap", "normalmap")])
MATT, MIRROR = {"type": "diffuse"}, {"type": "conductor"}


def warns_of_steps(scene, key: str) -> int:
    return sum("in 256 steps" in m and '"accel"' in m for m in said(scene, key))


@MAPS
@pytest.mark.parametrize(("inner", "key"), [(MATT, "board"), (MIRROR, "cube")], ids=["turns_away", "mirrors"])
def test_maps_that_are_interpolated_in_steps(in_steps, kind, name, inner, key):
    assert warns_of_steps(mapped_board(kind, name, inner), f"{key}.vertex_positions") == 1


@MAPS
def test_maps_without_steps(kind, name):
    assert warns_of_steps(mapped_board(kind, name, MATT), "board.vertex_positions") == 0


@MAPS
def test_steps_of_a_matt_map_that_stays_do_not_matter(in_steps, kind, name):
    assert warns_of_steps(mapped_board(kind, name, MATT), "cube.vertex_positions") == 0


@pytest.mark.parametrize("filter_type", ["nearest", "bilinear"])
def test_bitmaps_of_any_size_and_format_are_interpolated_without_steps(filter_type):
    random = np.random.default_rng(0)
    for size in (1, 2, 300, 3000):
        texels = random.random((size, size, 3))
        for values in (texels.astype(np.float32), texels.astype(np.float16), (255 * texels).astype(np.uint8)):
            made = {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, "filter_type": filter_type}
            place = mi.ScalarTransform3f().scale([2, 3]).rotate(20)
            assert not texture_lines._in_steps(mi.load_dict({**made, "to_uv": place}))


# ---------------------- Signed distances ----------------------


@pytest.mark.parametrize("options", [{}, {"sppi": 0}], ids=str)
def test_silhouettes_of_grids_that_are_no_cubes_are_warned_about(options):
    z, y, x = np.meshgrid(np.linspace(-1, 1, 8), np.linspace(-1, 1, 6), np.linspace(-1, 1, 8), indexing="ij")
    grid = mi.TensorXf((np.sqrt(x * x + y * y + z * z) - 0.8)[..., None].astype(np.float32))
    scene = cases.cube(grid=lambda: {"type": "sdfgrid", "grid": grid})()
    assert sum('silhouettes of "grid" (sdfgrid)' in m for m in said(scene, "cube.vertex_positions", **options)) == 1


# ---------------------- Participating media ----------------------


def foggy(where: str):
    fog = {**FOG, "id": "fog"}
    inside = {"interior": fog} if where == "shape" else {}
    sensor = {**cases.camera(), **({"medium": fog} if where == "sensor" else {})}
    cloud = {"type": "sphere", "bsdf": {"type": "null"}, **inside}
    return cases.scene(sensor=sensor, cloud=cloud, cube=cases.smooth_cube(), sky=cases.constant())


@pytest.mark.parametrize("kind", ["direct_edge", "prb_edge"])
@pytest.mark.parametrize("where", ["shape", "sensor"])
def test_media_are_warned_about(where, kind):
    """Even if nothing moves."""
    (message,) = said(foggy(where), "cube.bsdf.reflectance.value", kind=kind)
    assert "(HomogeneousMedium) for empty" in message


def test_scenes_without_media_say_nothing_of_them():
    assert not said(foggy("nowhere"), "cube.bsdf.reflectance.value")


@pytest.mark.parametrize("key", ["sigma_t.value.value", "albedo.value.value"])
def test_gradients_of_media_are_refused(key):
    scene = foggy("shape")
    params = mi.traverse(scene)
    (key,) = (k for k in params.properties if k.endswith(key))
    dr.enable_grad(params[key])
    params.update()
    with pytest.raises(
        RuntimeError, match=r"(sigma_t|albedo)\S* .*carries a gradient, but participating media are not"
    ):
        mi.load_dict({"type": "direct_edge"}).render_forward(scene, params, spp=1)


@pytest.mark.parametrize(
    ("quads", "integrator", "warned"),
    [
        (4, {"type": "direct_edge"}, False),
        (4, {"type": "prb_edge", "max_depth": 3}, True),
        (40, {"type": "prb_edge", "max_depth": 3}, False),
        (4, {"type": "rig", "max_depth": 2}, True),
    ],
)
def test_fringe_of_coarse_lamps(quads, integrator, warned):
    """The interpolated normals of a coarse ball turn away well inside of its outline."""
    points, _, _, faces = ball(quads)
    lamp = cases.mesh("lamp", 0.3 * points + [0, 2, 0], faces, normals=True, emitter=cases.light(3, 2, 1))
    floor = cases.horizontal((0, 0, 0), 2, "floor", bsdf=cases.diffuse(0.5))
    scene = cases.scene(sensor=cases.camera(), lamp=lamp, floor=floor)
    plan = rimlight.plan(scene, ["lamp.vertex_positions"], integrator=mi.load_dict(integrator))
    found = [limit for limit in plan.limits if "coarse mesh" in limit]
    assert len(found) == warned and all('"lamp"' in limit for limit in found)


@pytest.mark.parametrize(
    ("quads", "max_depth", "key", "samples"),
    [
        (4, 3, "vertex_positions", True),
        (4, 3, "vertex_normals", True),
        (4, 2, "vertex_positions", False),
        (16, 3, "vertex_positions", False),
        (16, 3, "vertex_normals", True),
    ],
)
def test_indirect_light_of_coarse_meshes(quads, max_depth, key, samples):
    """The jump where the normals of a mesh turn away from surfaces, and not from the camera."""
    points, _, _, faces = ball(quads)
    thing = cases.mesh("thing", 0.3 * points, faces, normals=True)
    floor = cases.horizontal((0, -0.3, 0), 2, "floor", bsdf=cases.diffuse(0.5))
    scene = cases.scene(sensor=cases.camera(), thing=thing, floor=floor, sky=cases.constant())
    params = mi.traverse(scene)
    dr.enable_grad(params[f"thing.{key}"])
    params.update()
    plan = mi.load_dict({"type": "prb_edge", "max_depth": max_depth}).plan(scene, spp=1)
    assert bool(plan.term("horizons from points").samples) == samples
    assert not any('"thing"' in limit for limit in plan.limits)


def test_flat_ground_around_a_coarse_thing_does_not_make_it_finer():
    """They are one mesh, of which the thing is a small part."""
    points, _, _, faces = ball(4)
    ground = np.array([[-40, -0.3, -40], [-40, -0.3, 40], [40, -0.3, -40], [40, -0.3, 40]])
    on_ground = np.concatenate([faces, len(points) + np.array([[0, 1, 2], [2, 1, 3]])])
    alone = cases.mesh("alone", 0.3 * points, faces, normals=True)
    thing = cases.mesh("thing", np.concatenate([0.3 * points, ground]), on_ground, normals=True)
    assert mean_fringe(thing) == pytest.approx(mean_fringe(alone), rel=1e-3)


@pytest.mark.parametrize("distance", [0, 100, 1e4])
def test_scenes_far_from_the_origin(distance):
    corners = np.add([distance, 0, 0], [[-1, -1, 0], [1, -1, 0], [0, 1, 0]])
    floor = cases.mesh("floor", corners, [[0, 1, 2]])
    sensor = cases.camera((distance, 0, -5), (distance, 0, 0))
    found = said(cases.scene(sensor=sensor, floor=floor, sky=cases.constant()), "floor.vertex_positions")
    assert ["Bring it close to the origin" in message for message in found] == [True] * (distance > 1000)


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "disk"])
@pytest.mark.parametrize("height", [-0.3, 0.0, 0.2])
def test_analytic_shapes_that_cut_hair_are_warned_about(kind, height, tmp_path):
    """Those that only touch are not, nor those that cut meshes."""
    T = mi.ScalarTransform4f
    turn = T().rotate([1, 0, 0], 90) if kind == "disk" else T().rotate([1, 0, 0], -90) if kind == "cylinder" else T()
    lowest = {"sphere": 0.5, "cylinder": 0.0, "disk": 0.5}[kind]
    place = T().translate([0.1, lowest + height, 0.2]) @ (turn if kind != "disk" else T()) @ T().scale(0.5)
    thing = {"type": kind, "to_world": place, "bsdf": cases.diffuse(0.5, two_sided=True)}
    floor = cases.horizontal((0, 0, 0), 2, "floor", bsdf=cases.diffuse(0.5, two_sided=True))
    strands = tmp_path / "strands"  # thick ones, on the floor
    strands.write_text("\n\n".join(f"-2 -0.3 {z} 0.3\n2 -0.3 {z} 0.3" for z in np.linspace(-0.4, 0.6, 11)))
    hair = {"type": "linearcurve", "filename": str(strands), "bsdf": cases.diffuse(0.5)}
    for others, warned in (({}, False), ({"hair": hair}, height < 0)):
        shapes = {"thing": thing, "floor": floor, **others}
        found = said(cases.scene(sensor=cases.camera(), **shapes, sky=cases.constant()), "thing.to_world")
        assert any("cut through shapes" in message and '"hair"' in message for message in found) == warned


@pytest.mark.parametrize(
    ("down", "grows", "text"),
    [(1.2, 0, '"wires" and "floor"'), (0, 0.1, "seen from their thin end"), (0, 0, "")],
)
def test_what_is_said_of_wires(down, grows, text):
    scene = wires.before_wall(cases.constant)()
    params = mi.traverse(scene)
    points = np.array(params["wires.control_points"]).reshape(-1, 4)
    points[:, 1] -= down
    points[0, 3] += grows
    params["wires.control_points"] = mi.Float(points.ravel())
    params.update()
    found = said(scene, "wires.control_points")
    assert any(text in message for message in found) if text else not found


SKIES = {
    "the border of the sun": {"type": "sunsky", "sun_direction": [0.2, 1, 0.3]},
    'the outlines of the discs of "sky"': {"type": "distant_lights", "directions": "0 1 0", "angular_radius": 3.0},
}


@pytest.mark.parametrize("text", SKIES)
@pytest.mark.parametrize(
    ("bsdf", "key", "warned"),
    [
        ("conductor", "plate.vertex_positions", True),
        ("diffuse", "plate.vertex_positions", False),
        ("diffuse", "sensor.to_world", True),
    ],
)
def test_suns_whose_outlines_are_seen(text, bsdf, key, warned):
    """By a camera that moves, or in a mirror that does."""
    plate = cases.horizontal((0, 0, 0), 1, "plate", bsdf={"type": bsdf})
    scene = cases.scene(sensor=cases.camera(), plate=plate, sky=SKIES[text])
    found = said(scene, key, kind="prb_edge", max_depth=3)
    assert any(text in message for message in found) == warned


# ---------------------- Transformations ----------------------


@pytest.mark.parametrize(("axis", "size", "count"), [([1, 1, 0], 1, 1), ([0, 1, 0], 1, 0), ([0.6, 0.8, 0], 1e5, 0)])
def test_axes_that_are_not_of_unit_length_are_warned_about(axis, size, count):
    """`rotate` shears then, and the inverse that Mitsuba keeps is another one."""
    place = mi.ScalarTransform4f().translate([3 * size, size, size]).rotate(axis, 20).scale([size, 1e-2 * size, size])
    thing = {"type": "disk", "id": "thing", "to_world": place}
    messages = said(
        cases.scene(sensor=cases.camera((0, 0, -5), (0, 0, 0)), thing=thing, sky=cases.constant()), "sensor.to_world"
    )
    assert len(messages) == count
    assert all('wrong for "thing"' in m for m in messages)


@pytest.mark.parametrize(("scale", "warned"), [((0.7, 0.7, 0.7), False), ((0.7, 0.6, 0.7), True)])
def test_stretched_spheres_are_warned_about(scale, warned):
    to_world = mi.ScalarTransform4f().rotate([0.6, 0.8, 0], 50).scale(list(scale))
    ball = {"type": "sphere", "to_world": to_world, "bsdf": cases.diffuse(0.5)}
    found = said(cases.scene(sensor=cases.camera(), ball=ball, sky=cases.constant()), "sensor.to_world")
    assert len(found) == warned and all("stretched" in message for message in found)


# ---------------------- Materials without a surface ----------------------


@pytest.mark.parametrize("wrapped", [False, True])
def test_a_bump_map_that_no_surface_has_is_not_warned_about(wrapped):
    """Files of exporters name what is inside of a bump map, and let their shapes refer to that."""
    paint = '<bsdf type="diffuse" id="paint"/>'
    checks = '<texture type="checkerboard"/>'
    scene = mi.load_string(
        f"""
        <scene version="3.0.0">
            <bsdf type="bumpmap" id="rough">{checks}{paint}</bsdf>
            <shape type="rectangle" id="floor"><ref id="{"rough" if wrapped else "paint"}"/></shape>
            <emitter type="constant"/>
            <sensor type="perspective"/>
        </scene>
        """
    )
    assert bool(texture_lines.jumping_textures(scene)) == wrapped
    assert not said(scene, "floor.to_world")


# ---------------------- Textures that slide ----------------------


@pytest.mark.parametrize(("bsdf", "missing"), [("conductor", 1), ("dielectric", 1), ("roughconductor", 0)])
def test_grids_that_are_mirrors_or_glass(bsdf, missing):
    thing = {"type": "sdfgrid", "grid": grids.grid(n=8)["grid"], "bsdf": {"type": bsdf}}
    scene = cases.scene(sensor=cases.camera(), thing=thing, sky=cases.constant())
    messages = said(scene, "thing.to_world", kind="prb_edge", max_depth=3)
    assert sum('in what "thing" (sdfgrid) show' in m for m in messages) == missing


def checkered(shape: str) -> dict:
    return {"type": shape, "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}}}


@pytest.mark.parametrize(("shape", "depth", "missing"), [("disk", 3, 1), ("disk", 2, 0), ("rectangle", 3, 0)])
def test_lines_of_textures_that_points_do_not_see(shape, depth, missing):
    scene = cases.scene(sensor=cases.camera(), thing=checkered(shape), sky=cases.constant())
    messages = said(scene, "thing.to_world", kind="prb_edge", max_depth=depth)
    assert len(messages) == missing
    assert all('in the light that "thing" throw on surfaces close to them, the jumps' in m for m in messages)


def test_textures_that_slide():
    scene = as_written.checkered_board()
    assert not said(scene, "board.vertex_texcoords", kind="prb_edge", max_depth=3)


def test_lamps_whose_textures_slide():
    make, motion, *_ = sliding_textures.SLIDING["lamp_slides"]
    (message,) = said(make(), motion["key"], kind="direct_edge")
    assert 'Mitsuba goes on to look for the light of "lamp"' in message
