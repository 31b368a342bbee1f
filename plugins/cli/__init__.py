"""The command line: ``rimlight`` and ``python -m rimlight``."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import tyro

from rimlight.edge_sampling.refusals import InputError, Refusal

from ._commands import commands

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    argv : arguments without the name of the program. Default: those of the process.

    Returns
    -------
    Exit code: 0 success, 1 `check` found a disagreement, 2 bad input (one line on standard error says which),
    130 interrupted.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    try:
        command = tyro.extras.subcommand_cli_from_dict(
            commands(argv),
            prog="rimlight",
            description="Derivatives of rendered images, visibility included, by edge sampling in Mitsuba 3.",
            args=argv,
        )
    except SystemExit as stop:  # --help, or options that tyro refuses
        return stop.code if isinstance(stop.code, int) else 2
    except InputError as error:
        print(f"rimlight: error: {error}", file=sys.stderr)
        return 2
    try:
        return command.run()
    except (InputError, Refusal) as error:
        print(f"rimlight: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("rimlight: interrupted", file=sys.stderr)
        return 130
