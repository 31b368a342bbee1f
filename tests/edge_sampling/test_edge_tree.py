"""The tree over the edges: its contents and statistics, and that it samples every boundary as often as it says."""

from __future__ import annotations

from dataclasses import dataclass

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from meshes import bumpy_sphere
from scipy.stats import chisquare

from rimlight.edge_sampling import Edges, Geometry, find_edges
from rimlight.edge_sampling.choice.edge_order import LEAF
from rimlight.edge_sampling.choice.edge_tree import EdgeTree
from rimlight.edge_sampling.choice.sampling import Reservoir, sample_edge
from rimlight.edge_sampling.choice.views import Cone, Lobe, View

# ---------------------- Meshes and trees ----------------------


def still_life() -> tuple[mi.Mesh, ...]:
    """Interpolated and flat normals, split vertices, open edges."""
    return (
        bumpy_sphere(60, centre=(3, 0.5, 0)),
        bumpy_sphere(40, 0.4, normals=False, centre=(-3, 0, 1)),
        cases.split_cube(),
        cases.quad([-1, 3, 0], [2, 0, 0], [0, 1, 1], "sheet"),
    )


@dataclass
class Setup:
    """A tree with what it is over."""

    tree: EdgeTree
    geometry: Geometry
    edges: Edges

    def numbers(self, which: str) -> np.ndarray:
        """Numbers of each of the `nodes` or `slots`."""
        return np.concatenate([np.array(packet).reshape(-1, 4) for packet in getattr(self.tree, which)], axis=1)

    def root(self, group: int = 0) -> dict[str, np.ndarray]:
        node = self.tree.node(self.tree.roots[group])
        return {name: np.array(value, float).reshape(-1) for name, value in vars(node).items()}

    def end_points(self) -> tuple[np.ndarray, np.ndarray]:
        position = self.geometry.host_positions().astype(float)
        return position[self.edges.vertices[:, 0, 0]], position[self.edges.vertices[:, 0, 1]]

    def planes(self) -> tuple[np.ndarray, np.ndarray]:
        """Planes (n, d) of the faces on both sides of each edge, relative to the centre of the tree."""
        position, (a, b) = self.geometry.host_positions().astype(float), self.end_points()
        planes = []
        for side, sign in ((0, 1), (1, -1)):
            n = sign * np.cross(b - a, position[self.edges.opposite[:, side]] - a)
            n /= np.linalg.norm(n, axis=1, keepdims=True)
            planes.append(np.concatenate([n, dots(n, a - np.array(self.tree.centre).ravel())[:, None]], 1))
        return tuple(planes)

    def boundaries(self, p) -> tuple[np.ndarray, np.ndarray]:
        """Which edges are boundaries as seen from p, and of which rounding may decide."""
        y = np.append(np.array(p) - np.array(self.tree.centre).ravel(), -1)
        s, t = (q @ y for q in self.planes())
        distance = np.linalg.norm(self.end_points()[0] - p, axis=1)
        return (s * t <= 0) | (self.edges.count != 2), np.minimum(np.abs(s), np.abs(t)) < 1e-5 * distance


def tree_over(*meshes: mi.Mesh, groups=lambda edges: [np.arange(len(edges))]) -> Setup:
    geometry = Geometry(meshes, ())
    edges = find_edges(geometry)
    tree = EdgeTree(geometry, edges, groups(edges))
    tree.refit(geometry.positions())
    return Setup(tree, geometry, edges)


def odd_and_even(edges: Edges) -> list[np.ndarray]:
    return [np.arange(0, len(edges), 2), np.arange(1, len(edges), 2)]


def dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", a, b)


def unit(*v: float) -> np.ndarray:
    return np.array(v) / np.linalg.norm(v)


# ---------------------- Contents ----------------------


@pytest.mark.parametrize("points", [4, 5, 6, 12, 15, 47, 300])
@pytest.mark.parametrize("groups", [None, odd_and_even], ids=["one group", "two groups"])
def test_every_edge_is_in_exactly_one_slot(points, groups):
    setup = tree_over(bumpy_sphere(points), **({"groups": groups} if groups else {}))
    edge = np.array(setup.tree.slot_edge)
    assert (np.sort(edge) == np.arange(3 * points - 6)).all()
    for root, group in zip(setup.tree.roots, groups(setup.edges) if groups else [edge], strict=True):
        assert set(edge[slots_below(setup.tree, root)]) == set(group)


def slots_below(tree: EdgeTree, root: mi.UInt32) -> list[int]:
    """Of all leaves below a node."""
    inner, found, nodes = tree.inner[0], [], [root[0]]
    for node in nodes:
        if node >= inner:
            first, count = (x[0] for x in tree.slots_of(mi.UInt32(node)))
            assert 0 < count <= LEAF
            found += range(first, first + count)
        else:
            nodes += [child[0] for child in tree.children(mi.UInt32(node))]
    assert len(set(nodes)) == len(nodes) and len(set(found)) == len(found)
    return found


def statistics(setup: Setup, chosen=slice(None)) -> dict[str, np.ndarray]:
    """What the root of a tree over silhouettes says, in double precision."""
    c = np.array(setup.tree.centre).ravel()
    a, b = (v[chosen] - c for v in setup.end_points())
    planes = [q[chosen] for q in setup.planes()]
    length = np.linalg.norm(b - a, axis=1)
    weights = length / length.sum()
    middle, Δ = (planes[0] + planes[1]) / 2, planes[0] - planes[1]
    mean = weights @ middle
    difference = np.einsum("e,ei,ej->ij", weights, Δ, Δ)
    return {
        "silhouettes": length.sum(),
        "always": 0,
        "lower": np.minimum(a, b).min(0),
        "upper": np.maximum(a, b).max(0),
        "mean": mean,
        "variance": np.einsum("e,ei,ej->ij", weights, middle - mean, middle - mean) + difference / 12,
        "difference": difference,
        "plane_lower": np.minimum(*planes).min(0),
        "plane_upper": np.maximum(*planes).max(0),
    }


def assert_equal(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    for name, value in expected.items():
        if name in ("variance", "difference"):
            value = value[np.triu_indices(4)]
        assert np.allclose(found[name], value, rtol=1e-4, atol=2e-5), name


@pytest.mark.parametrize("centre", [(0, 0, 0), (100, -30, 20)])
def test_root_knows_moments_and_boxes(centre):
    setup = tree_over(bumpy_sphere(200, centre=centre))
    assert_equal(setup.root(), statistics(setup))


def test_root_of_each_group_knows_its_own():
    setup = tree_over(bumpy_sphere(200), groups=odd_and_even)
    for k, group in enumerate(odd_and_even(setup.edges)):
        assert_equal(setup.root(k), statistics(setup, group))


def test_open_edges_count_as_always():
    setup = tree_over(*still_life())
    a, b = setup.end_points()
    length, is_open = np.linalg.norm(b - a, axis=1), setup.edges.open
    assert is_open.sum() == 4
    assert setup.root()["always"] == pytest.approx(length[is_open].sum())
    assert setup.root()["silhouettes"] == pytest.approx(length[~is_open].sum(), rel=1e-5)


# ---------------------- Refit ----------------------


def moved(setup: Setup) -> mi.Float:
    p = setup.geometry.host_positions()
    return mi.Float((p + 0.2 * np.sin(3 * p[:, [1, 2, 0]])).astype(np.float32).ravel())


@pytest.mark.parametrize("groups", [None, odd_and_even], ids=["one group", "two groups"])
def test_refit_leaves_nothing_of_the_former_positions(groups):
    options = {"groups": groups} if groups else {}
    refitted, fresh = (tree_over(*still_life(), **options) for _ in range(2))
    for arrays in (fresh.tree.nodes, fresh.tree.slots):
        arrays[:] = [dr.zeros_like(a) for a in arrays]
    for setup in (refitted, fresh):
        before = setup.numbers("nodes")
        setup.tree.refit(moved(setup))
    for which in ("nodes", "slots"):
        assert (refitted.numbers(which) == fresh.numbers(which)).all()
    assert (before != fresh.numbers("nodes")).any()


def test_refit_does_the_same_whether_it_is_recorded_replayed_or_traced():
    setups = [tree_over(*still_life(), groups=odd_and_even) for _ in range(3)]
    recorded, traced, frozen = (setup.tree for setup in setups)
    # A function that users freeze has the refit as a part of its own recording.
    in_users_function = dr.freeze(lambda tree, positions: tree.refit(positions))
    p = mi.Float(setups[0].geometry.positions())
    for k in range(4):
        q = p * dr.opaque(mi.Float, 1 + 0.3 * k)
        recorded.refit(q)
        traced.nodes, traced.slots = traced._fitted(q)
        # In turn, by its own recording and by theirs.
        frozen.refit(q) if k % 2 else in_users_function(frozen, q)
        for which in ("nodes", "slots"):
            expected = setups[1].numbers(which)
            assert all((setup.numbers(which) == expected).all() for setup in setups)
    assert in_users_function.n_recordings == 1


def test_refit_needs_little_memory_besides_the_tree():
    """No copy of it for each level."""
    setup = tree_over(bumpy_sphere(8000))
    for _ in range(3):
        dr.sync_thread()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        setup.tree.refit(moved(setup))
        dr.sync_thread()
    assert dr.detail.malloc_watermark(dr.JitBackend.LLVM) < 4 * setup.tree.bytes


def test_refit_root_equals_that_of_a_tree_built_there():
    setup = tree_over(bumpy_sphere(200))
    positions = moved(setup)
    setup.tree.refit(positions)
    params = mi.traverse(setup.geometry.meshes[0])
    params["vertex_positions"] = positions
    params.update()
    assert_equal(setup.root(), statistics(setup))


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_vertices_that_are_not_finite_spoil_nothing_else(bad):
    setup = tree_over(bumpy_sphere(100), groups=odd_and_even)
    p = setup.geometry.host_positions()
    p[::10] = bad
    setup.tree.refit(mi.Float(p.ravel()))
    for name, value in {**setup.root(0), "of the other": np.concatenate(list(setup.root(1).values()))}.items():
        assert np.isfinite(value).all(), name
    assert not np.isnan(setup.numbers("nodes")).any()
    assert np.isfinite(setup.numbers("slots")).all()
    edge, t, density = draw(setup, (4, 1, 0.5), 20000)
    assert np.isfinite(density).all() and np.isfinite(t[density > 0]).all()
    assert np.isfinite(p[setup.edges.vertices[edge[density > 0], 0]]).all()
    assert (density > 0).mean() > 0.3


def test_a_mesh_of_points_has_no_boundaries():
    setup = tree_over(bumpy_sphere(30))
    setup.tree.refit(dr.zeros(mi.Float, 90))
    assert not (draw(setup, (4, 1, 0.5), 1000)[2] > 0).any()


# ---------------------- Sampling ----------------------


def draw(
    setup: Setup,
    p,
    count: int,
    *,
    n=(0, 0, 0),
    wide: float = 1,
    lobes=(),
    cone=None,
    use=None,
    candidates: int = 1,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges, parameters and densities of samples as seen from p. Lobes are (axis, peak, width), cones (axis, angle). Of
    several candidates, one is kept in proportion to length / distance."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    # Opaque: all views share one kernel.
    number = lambda x: dr.opaque(mi.Float, float(x), count)
    vector = lambda v: mi.Vector3f(*map(number, v))
    p = vector(p - np.array(setup.tree.centre).ravel())
    lobes = [Lobe(vector(axis), number(peak), number(width)) for axis, peak, width in lobes]
    if cone is not None:
        axis, angle = cone
        cone = Cone(vector(axis), number(np.cos(angle)), number(np.sin(angle)))
    view = View(p, vector(n), number(wide), lobes, cone)
    use = use or [True] * len(setup.tree.roots)
    choice = sampler.next_1d()

    def sample(k, sampler):
        part = (choice + k) / candidates
        return sample_edge(setup.tree, view, sampler, use, choice=part, active=mi.Bool(True))

    def length_by_distance(e):
        a, b = setup.tree.device_edges.end_points(setup.geometry.positions(), e.edge)
        return dr.norm(b - a) / dr.norm(dr.lerp(a, b, e.t) - setup.tree.centre - view.p)

    active = dr.full(mi.Bool, True, count)
    reservoir = dr.zeros(Reservoir, count)
    for k in range(candidates):
        e = sample(k, sampler)
        reservoir, _ = reservoir.take(e, length_by_distance(e), sampler, active)
    e = reservoir.kept(candidates)
    dr.eval(e)
    return np.array(e.edge), np.array(e.t, float), np.array(e.density, float)


def above(v: np.ndarray, p, n) -> np.ndarray:
    return (v - p) @ n > 1e-6 * np.linalg.norm(v - p, axis=1)


def assert_unbiased(setup: Setup, p, samples, lanes=slice(None), among=slice(None), n=None) -> None:
    """The mean of 1 / density is 1 on every boundary: it is the integral of 1 over t."""
    edge, t, density = (a[lanes] for a in samples)
    count, size = len(edge), len(setup.edges)
    hit = density > 0
    assert np.isfinite(density).all() and ((t >= 0) & (t <= 1))[hit].all()
    boundary, ambiguous = setup.boundaries(p)
    wanted = np.zeros(size, bool)
    wanted[among] = True
    allowed = (boundary | ambiguous) & wanted
    if n is not None:
        a, b = setup.end_points()
        wanted &= above(a, p, n) | above(b, p, n)
    wanted &= boundary & ~ambiguous
    assert allowed[edge[hit]].all()

    hits = np.bincount(edge[hit], minlength=size)[wanted]
    assert wanted.sum() > 3 and hits.min() >= 20, f"{hits.min()} samples are too few for a test"
    weight = np.divide(1, density, where=hit, out=np.zeros(count))
    mean, square = (np.bincount(edge, weight**k, minlength=size)[wanted] / count for k in (1, 2))
    # The variance that a mean of 1 would have: where few samples hit, their own depends too much on how many.
    z = (mean - 1) / np.sqrt((square / mean - 1) / count)
    assert np.abs(z).max() < 4
    assert np.mean(z**2) < 1 + 4 * np.sqrt(2 / len(z))


TOWARDS_IT = unit(-1, 0.2, 0.1)
LOBE = (unit(1, 0.2, 0.3), 20, 0.01)
VIEWS = {
    "far": ("bumpy", (4, 1, 0.5), {}),
    "far, above a plane": ("bumpy", (4, 1, 0.5), {"n": TOWARDS_IT}),
    "near": ("bumpy", (1.3, 0, 0.2), {}),
    "near, above another plane": ("bumpy", (1.3, 0, 0.2), {"n": TOWARDS_IT}),
    "near, above a plane": ("bumpy", (1.3, 0, 0.2), {"n": unit(0, 0.3, 1)}),
    "in the box": ("bumpy", (0.8, 0.8, 0.8), {}),
    "in the box, above a plane": ("bumpy", (0.8, 0.8, 0.8), {"n": TOWARDS_IT}),
    "lobe": ("bumpy", (-3, 0, -0.5), {"lobes": [LOBE]}),
    "lobe only": ("bumpy", (-3, 0, -0.5), {"lobes": [(unit(1, 0.2, 0.3), 1, 0.05)], "wide": 0}),
    "still life": ("still life", (0, 2, -4), {}),
    "still life, above a plane": ("still life", (0, 2, -4), {"n": unit(0.2, -0.3, 1)}),
    "still life, inside of the sphere": ("still life", (3, 0.5, 0.3), {}),
    "still life, below the sheet": ("still life", (0.2, 3.1, 0.3), {"n": unit(0.2, -1, 0.5)}),
    "still life, in the cube": ("still life", (0.1, 0, 0), {}),
    "still life, two lobes": (
        "still life",
        (0, 2, -4),
        {"lobes": [(unit(0, -0.3, 1), 20, 0.01), (unit(0.5, 0, 1), 2, 0.1)], "wide": 3},
    ),
}


@pytest.fixture(scope="module")
def scenes(variant) -> dict[str, Setup]:
    return {"bumpy": tree_over(bumpy_sphere(300)), "still life": tree_over(*still_life())}


@pytest.mark.parametrize(("scene", "p", "options"), VIEWS.values(), ids=VIEWS)
def test_every_boundary_is_sampled_as_often_as_its_density_says(scenes, scene, p, options):
    setup = scenes[scene]
    assert_unbiased(setup, p, draw(setup, p, 2**20, **options), n=options.get("n"))


def test_groups_are_sampled_where_they_are_wanted():
    """The second group only by every other sample."""
    first = len(find_edges(Geometry(still_life()[:1], ())))
    setup = tree_over(*still_life(), groups=lambda edges: [np.arange(first, len(edges)), np.arange(first)])
    count, p = 2**19, (-0.5, 2, -4)
    both = np.arange(count) % 2 == 0
    samples = draw(setup, p, count, use=[True, mi.Bool(both)])
    assert_unbiased(setup, p, samples, both)
    assert_unbiased(setup, p, samples, ~both, slice(first, None))


CONES = {
    "narrow": ("bumpy", (4, 1, 0.5), (unit(-1, 0, -0.1), 0.05), {}),
    "wide": ("bumpy", (1.3, 0, 0.2), (unit(0, 0.9, -0.3), 0.9), {}),
    "near": ("bumpy", (1.3, 0, 0.2), (unit(-0.5, 0.5, -0.3), 0.3), {}),
    "over long edges": ("still life", (0, 2, -4), (unit(0.1, -0.2, 1), 0.2), {}),
    "along long edges": ("still life", (-4, 3.02, 0.02), (unit(1, -0.05, 0), 0.25), {}),
    "with a lobe": ("bumpy", (4, 1, 0.5), (unit(-1, -0.2, 0), 0.2), {"lobes": [(unit(-1, -0.2, 0), 20, 0.05)]}),
    "around a point in the mesh": ("bumpy", (0.8, 0.8, 0.8), (unit(-1, 0.1, 0.3), 1.2), {}),
}


@pytest.mark.parametrize(("scene", "p", "cone", "options"), CONES.values(), ids=CONES)
def test_all_of_a_cone_is_sampled_and_nothing_else(scenes, scene, p, cone, options):
    """The mean of 1 / density is the part of the edge that is in the cone."""
    setup, count = scenes[scene], 2**19
    edge, t, density = draw(setup, p, count, cone=cone, **options)
    hit = density > 0
    a, b = setup.end_points()
    axis, angle = cone

    def off(points):
        d = points - np.array(p)
        return np.arccos(np.clip(d @ axis / np.linalg.norm(d, axis=-1), -1, 1))

    at = a[edge[hit]] + t[hit, None] * (b - a)[edge[hit]]
    assert off(at).max() <= angle + 1e-3
    boundary, ambiguous = setup.boundaries(p)
    assert (boundary | ambiguous)[edge[hit]].all()
    s, part = (np.arange(4000) + 0.5) / 4000, np.zeros(len(a))
    for e in np.flatnonzero(boundary & ~ambiguous):
        part[e] = (off(a[e] + s[:, None] * (b - a)[e]) <= angle).mean()
    weight = np.divide(1, density, where=hit, out=np.zeros(count))
    mean, square = (np.bincount(edge, weight**k, minlength=len(a)) / count for k in (1, 2))
    inside = part > 0
    assert inside.sum() >= 2
    assert np.bincount(edge[hit], minlength=len(a))[inside].min() >= 20
    error = np.sqrt((square - mean**2)[inside] / count)
    assert (np.abs(mean - part)[inside] <= 4.5 * error + 1 / 4000).all()


def test_what_is_behind_the_plane_is_not_sampled(scenes):
    assert not (draw(scenes["bumpy"], (4, 1, 0.5), 1000, n=unit(1, 0, 0))[2] > 0).any()


# ---------------------- Frequencies ----------------------


def chi_squared(edge: np.ndarray, t: np.ndarray, density: np.ndarray, bins: int = 16) -> float:
    """p-value of the samples, counted by edge and by intervals of t, with what the density promises. The density is a
    function of edge and t: the samples tabulate it."""
    hit = density > 0
    observed, expected = [], []
    for e in np.unique(edge[hit]):
        of_edge = np.flatnonzero(hit & (edge == e))
        if len(of_edge) < 50 * bins:
            continue
        of_edge = of_edge[np.argsort(t[of_edge])]
        at = np.concatenate([[0], t[of_edge], [1]])
        value = np.pad(density[of_edge], 1, mode="edge")
        cumulative = np.concatenate([[0], np.cumsum(np.diff(at) * (value[1:] + value[:-1]) / 2)])
        # Intervals of equal probability.
        limits = np.interp(np.linspace(0, cumulative[-1], bins + 1)[1:-1], cumulative, at)
        observed += list(np.bincount(np.searchsorted(limits, t[of_edge]), minlength=bins))
        expected += [len(edge) * cumulative[-1] / bins] * bins
    rest = len(edge) - sum(observed), len(edge) - sum(expected)
    if rest[0] >= 20:
        observed.append(rest[0])
        expected.append(rest[1])
    assert len(observed) > bins
    expected = np.array(expected) * (sum(observed) / sum(expected)) if rest[0] < 20 else expected
    return chisquare(observed, expected).pvalue


FREQUENCIES = {
    "far": ("bumpy", (4, 1, 0.5), {}),
    "near, above another plane": ("bumpy", (1.3, 0, 0.2), {"n": TOWARDS_IT}),
    "all around": ("still life", (0.2, 3.1, 0.3), {}),
    "narrow lobe": ("bumpy", (1.3, 0, 0.2), {"lobes": [(unit(-0.3, 0.9, 0.15), 3000, 0.01)]}),
    "narrow lobe beside an edge": ("still life", (0, 2, -4), {"lobes": [(unit(0.05, 1.2, 4), 3000, 0.01)]}),
    "narrow lobe only": (
        "still life",
        (0.1, 1, 0.4),
        {"lobes": [(unit(-0.05, 2, 0), 3000, 0.01)], "wide": 0, "n": unit(0, 1, 0)},
    ),
    "narrow lobe along an edge": ("still life", (-4, 3.02, 0.02), {"lobes": [(unit(1, -0.002, 0), 3000, 0.01)]}),
    "two lobes": (
        "still life",
        (0, 2, -4),
        {"lobes": [(unit(0.05, 1.2, 4), 3000, 0.01), (unit(-0.8, -0.4, 1), 30, 0.1)], "wide": 0.1},
    ),
}


@pytest.mark.parametrize(("scene", "p", "options"), FREQUENCIES.values(), ids=FREQUENCIES)
def test_frequencies_of_edges_and_points_are_as_reported(scenes, scene, p, options):
    assert chi_squared(*draw(scenes[scene], p, 2**19, **options)) > 1e-4


@pytest.mark.parametrize(
    "wrong", [lambda t: t**1.03, lambda t: 0.99 * t, lambda t: t], ids=["skewed", "short", "right"]
)
def test_chi_squared_notices_wrong_points(scenes, wrong):
    edge, t, density = draw(scenes["bumpy"], (4, 1, 0.5), 2**19)
    assert (chi_squared(edge, wrong(t), density) > 1e-4) == (wrong(0.5) == 0.5)


def test_chi_squared_notices_wrong_probabilities(scenes):
    edge, t, density = draw(scenes["bumpy"], (4, 1, 0.5), 2**19)
    assert chi_squared(edge, t, density * np.where(edge % 2 == 0, 1.05, 0.95)) < 1e-4


# ---------------------- Efficiency ----------------------


def second_moment(setup: Setup, distance: float, candidates: int = 1, points: int = 18, count: int = 20000) -> float:
    """Of length / distance over the silhouettes, relative to the square of the mean; 1 is perfect. Mean over points at
    `distance`, in radii of the first mesh."""
    a, b = setup.end_points()
    vertices = setup.geometry.host_positions().astype(float)[: setup.geometry.meshes[0].vertex_count()]
    centre = vertices.mean(0)
    radius = np.linalg.norm(vertices - centre, axis=1).max()
    length = np.linalg.norm(b - a, axis=1)
    rng, moments, totals = np.random.default_rng(0), [], []
    for _ in range(points):
        p = centre + unit(*rng.normal(size=3)) * radius * distance
        edge, t, density = draw(setup, p, count, candidates=candidates)
        hit = density > 0
        at = a[edge] + t[:, None] * (b - a)[edge]
        weight = np.zeros(count)
        weight[hit] = (length[edge] / np.linalg.norm(at - p, axis=1))[hit] / density[hit]
        along = [dots(v - p, (b - a) / length[:, None]) for v in (a, b)]
        off = np.linalg.norm(np.cross(a - p, b - a), axis=1) / length
        truth = (np.arcsinh(along[1] / off) - np.arcsinh(along[0] / off))[setup.boundaries(p)[0]].sum()
        totals.append(weight.mean() / truth)
        moments.append((weight**2).mean() / truth**2)
    assert np.mean(totals) == pytest.approx(1, abs=0.02)
    return float(np.mean(moments))


LIMITS = {1: 3, 4: 1.5}  # of the second moment, by the number of candidates


@pytest.fixture(scope="module", params=["bumpy sphere", "beside large ones", "bunny"])
def many_edges(variant, shared, request) -> Setup:
    if request.param == "bumpy sphere":
        return tree_over(bumpy_sphere(6700, 0.25))
    if request.param == "beside large ones":
        return tree_over(bumpy_sphere(6700, 0.25), cases.quad([-5, -1.3, -5], [10, 0, 0], [0, 0, 10], "floor"))
    return tree_over(mi.load_dict({"type": "ply", "filename": str(shared("scenes/redner/bunny_box_bunny.ply"))}))


@pytest.mark.parametrize("candidates", LIMITS)
@pytest.mark.parametrize("distance", [4, 1.15], ids=["far", "near"])
def test_second_moment(many_edges, distance, candidates):
    moment = second_moment(many_edges, distance, candidates)
    print(f"{len(many_edges.edges)} edges, {distance} radii away: second moment {moment:.2f}")
    assert moment <= LIMITS[candidates]


def test_memory():
    setup = tree_over(bumpy_sphere(33340))
    assert len(setup.edges) > 100_000
    assert setup.tree.bytes <= 160 * len(setup.edges)
