"""Properties of a plugin: none is swallowed silently."""

from __future__ import annotations

from difflib import get_close_matches

import mitsuba as mi

#: Properties of Mitsuba's projective integrators that edge sampling has no use for. A scene file may keep them, so that
#: one word is enough to switch.
PROJECTIVE = ("guiding", "guiding_proj", "guiding_rounds", "project_seed")


def check_options(props: mi.Properties, known: tuple[str, ...], without: dict[str, str]) -> None:
    """Refuse properties that a plugin does not have. Mitsuba itself refuses only those that no base class reads.

    known : the names of its properties.
    without : properties of similar plugins that this one does not have, each with a remedy.

    Raises
    ------
    ValueError : there is another one.
    """
    who, idle = props.plugin_name(), []
    for key in props.keys():  # noqa: SIM118 (not a dictionary)
        if key in known:
            continue
        if key in PROJECTIVE:
            props.mark_queried(key)
            idle.append(f'"{key}"')
            continue
        if key in without:
            raise ValueError(f'{who}: there is no property "{key}". {without[key]}')
        near = get_close_matches(key, known, n=1)
        remedy = f'did you mean "{near[0]}"?' if near else f"known are {', '.join(known)}."
        raise ValueError(f'{who}: unknown property "{key}", {remedy}')
    if idle:
        have = "has" if len(idle) == 1 else "have"
        mi.Log(mi.LogLevel.Warn, f"{who}: {', '.join(idle)} {have} no effect, since edge sampling needs no guiding.")


def is_whole(value: object) -> bool:
    """Is it a whole number? Python takes True for one."""
    return isinstance(value, int) and not isinstance(value, bool)
