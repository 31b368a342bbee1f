"""Properties of a plugin: none is swallowed silently."""

from __future__ import annotations

from difflib import get_close_matches

import mitsuba as mi

from rimlight.edge_sampling.refusals import InputError

#: Properties of Mitsuba's projective integrators that edge sampling has no use for. A scene file may keep them, so that
#: one word is enough to switch.
PROJECTIVE = ("guiding", "guiding_proj", "guiding_rounds", "project_seed")


def check_options(props: mi.Properties, known: tuple[str, ...], idle: tuple[str, ...] = ()) -> None:
    """Refuse properties that a plugin does not have. Mitsuba itself refuses only those that no base class reads. Those
    that Mitsuba's projective integrators have, but this plugin has no use for, are accepted, with one line in the log.

    known : the names of its properties.
    idle : properties that have no effect, besides `PROJECTIVE`.

    Raises
    ------
    ValueError : there is another one.
    """
    who, found = props.plugin_name(), []
    for key in props.keys():  # noqa: SIM118 (not a dictionary)
        if key in known:
            continue
        if key not in (*PROJECTIVE, *idle):
            near = get_close_matches(key, known, n=1)
            remedy = f'did you mean "{near[0]}"?' if near else f"known are {', '.join(known)}."
            raise InputError(f'{who}: unknown property "{key}", {remedy}')
        props.mark_queried(key)
        found.append(f'"{key}"')
    if found:
        have = "has" if len(found) == 1 else "have"
        mi.Log(mi.LogLevel.Warn, f"{who}: {', '.join(found)} {have} no effect on it.")


def is_whole(value: object) -> bool:
    """Is it a whole number? Python takes True for one."""
    return isinstance(value, int) and not isinstance(value, bool)
