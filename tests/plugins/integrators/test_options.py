"""Properties of the plugins: none is unknown, unused or of the wrong kind without a word."""

from __future__ import annotations

import cases
import mitsuba as mi
import pytest

INTEGRATORS = ("direct_edge", "prb_edge", "rig")


@pytest.mark.parametrize("kind", INTEGRATORS)
@pytest.mark.parametrize(
    ("key", "near"), [("sppii", "sppi"), ("hide_emitter", "hide_emitters"), ("spp_p", "sppp")], ids=lambda text: text
)
def test_misspelt_properties_of_integrators_are_refused(kind, key, near):
    with pytest.raises(RuntimeError, match=f'{kind}: unknown property "{key}", did you mean "{near}"'):
        mi.load_dict({"type": kind, key: 1})


@pytest.mark.parametrize("kind", ["prb_edge", "rig"])
def test_misspelt_depths_are_refused(kind):
    with pytest.raises(RuntimeError, match='unknown property "maxdepth", did you mean "max_depth"'):
        mi.load_dict({"type": kind, "maxdepth": 3})


@pytest.mark.parametrize("kind", INTEGRATORS)
@pytest.mark.parametrize("key", ["block_size", "samples_per_pass", "timeout"])
def test_properties_that_only_bases_read_are_refused(kind, key):
    """Mitsuba's base classes read these, but renderings by these integrators do not heed them."""
    with pytest.raises(RuntimeError, match=f'{kind}: unknown property "{key}", known are sppc'):
        mi.load_dict({"type": kind, key: 8})


@pytest.mark.parametrize("key", ["max_depth", "rr_depth"])
def test_depths_have_no_effect_on_direct_edge(key):
    """As with `direct_projective`, whose scene files may hold them."""
    options = f'<integer name="{key}" value="3"/>'
    xml = f'<scene version="3.0.0"><integrator type="direct_edge">{options}</integrator></scene>'
    for load in (lambda: mi.load_dict({"type": "direct_edge", key: 3}), lambda: mi.load_string(xml)):
        with cases.messages() as messages:
            load()
        (line,) = messages
        assert f'direct_edge: "{key}" has no effect' in line


@pytest.mark.parametrize("kind", INTEGRATORS)
@pytest.mark.parametrize("key", ["sppc", "sppp", "sppi"])
@pytest.mark.parametrize("value", [True, False, 1.0])
def test_sample_counts_are_whole_numbers(kind, key, value):
    with pytest.raises(RuntimeError, match=f'{kind}: "{key}" must be a whole number >= 0, got {value}'):
        mi.load_dict({"type": kind, key: value})


@pytest.mark.parametrize("kind", INTEGRATORS)
def test_options_of_the_projective_integrators_have_no_effect(kind):
    """So that one word is enough to switch. `prb_projective` must accept them, too."""
    options = {"guiding": "grid", "guiding_proj": False, "guiding_rounds": 2, "project_seed": "bsdf", "sppi": 8}
    mi.load_dict({"type": "prb_projective", **options})
    with cases.messages() as messages:
        mi.load_dict({"type": kind, **options})
    (line,) = messages
    assert kind in line and "have no effect" in line and all(f'"{key}"' in line for key in options if key != "sppi")


@pytest.mark.parametrize(
    "plugin",
    [
        {"type": "blinn_phong"},
        {"type": "ggx_dictionary", "material": "gold-paint"},
        {"type": "glass"},
        {"type": "distant_lights", "directions": "0 0 1"},
        {"type": "led"},
        {"type": "fisheye"},
    ],
    ids=lambda plugin: plugin["type"],
)
def test_unknown_properties_of_other_plugins_are_refused(plugin):
    with pytest.raises(RuntimeError, match="no_such_property"):
        mi.load_dict({**plugin, "no_such_property": 1})


def test_integrators_that_override_sample_are_refused():
    """Their images would follow it, and their derivatives would not."""
    base = next(c for c in type(mi.load_dict({"type": "direct_edge"})).__mro__ if hasattr(c, "TRACER"))
    with pytest.raises(TypeError, match="derivatives do not call `sample`"):
        type("Mine", (base,), {"sample": lambda self, *_, **__: None})


# ---------------------- Depths that are set between two calls ----------------------


@pytest.mark.parametrize("kind", ["prb_edge", "bdpt_edge", "bdpt", "rig"])
def test_depths_are_attributes_as_well(kind):
    it = mi.load_dict({"type": kind, "max_depth": 2})
    it.max_depth, it.rr_depth = 4, 7
    assert (it.max_depth, it.rr_depth) == (it.depths.max_depth, it.depths.rr_depth) == (4, 7)
    for key, value in (("max_depth", -2), ("max_depth", 2.5), ("rr_depth", 0)):
        with pytest.raises(ValueError, match=f'{kind}: "{key}" must be a whole number'):
            setattr(it, key, value)


@pytest.mark.parametrize(("kind", "longest"), [("bdpt_edge", 32), ("rig", 16)])
def test_attributes_know_the_longest_path(kind, longest):
    it = mi.load_dict({"type": kind})
    for value in (-1, longest + 1):
        with pytest.raises(ValueError, match=f'{kind}: "max_depth" must be at most {longest}, got {value}'):
            it.max_depth = value
    it.max_depth = longest


def test_depths_cannot_be_set_on_direct_edge():
    it = mi.load_dict({"type": "direct_edge"})
    assert it.max_depth == 2
    with pytest.raises(ValueError, match='direct_edge: "max_depth" cannot be set'):
        it.max_depth = 5
