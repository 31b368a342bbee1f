"""`rimlight reflectance`: weights of lobes for measured tables, and dictionaries of lobes."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import OmitSubcommandPrefixes, Positional, arg, subcommand

from rimlight import ggx, merl_tables
from rimlight.inverse import reflectance
from rimlight.loading import InputError, expected

from ._loading import at_least, check_output


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Fit the weights of a dictionary of lobes to a table. The result is for the plugin `ggx_dictionary`."""

    table: Annotated[Positional[Path], arg(metavar="TABLE.binary")]
    """Table in the format of the MERL database."""
    out: Annotated[Positional[Path], arg(metavar="OUT.json")]
    """File to write, with lobes and weights."""
    dictionary: Annotated[Path, arg(metavar="FILE.json")] = ggx.SHIPPED
    """Dictionary of lobes, as `rimlight reflectance reduce` writes it. Default: the dictionary of the package."""

    def run(self) -> int:
        check_output(self.out, folder=False, option="OUT.json")
        with expected(ValueError, OSError):
            lobes, _ = ggx.read_dictionary(self.dictionary)
            table = merl_tables.read_merl(self.table)
        weights = reflectance.fit(table, lobes)
        with expected(OSError, who="OUT.json"):
            ggx.write(self.out, lobes, weights)
        rms, cost = reflectance.error(table, lobes, weights)
        print(f"{np.count_nonzero(weights.any(1))} of {len(lobes)} lobes, rms {rms:.1%}, cost {cost:.1%}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Reduce:
    """Choose the lobes that describe the tables of a folder best. Prints the error of each material."""

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """Folder with tables in the format of the MERL database. All files *.binary are used."""
    out: Annotated[Positional[Path], arg(metavar="OUT.json")]
    """File to write, with the lobes and the weights of each material."""
    lobes: int = 40
    """Number of lobes to keep."""
    alphas: int = 12
    """Largest number of different alphas to keep. Fewer are cheaper to evaluate."""
    etas: int = 8
    """Largest number of different etas to keep. Fewer are cheaper to evaluate."""
    alpha_range: tuple[float, float] = (0.003, 1.0)
    """Smallest and largest alpha of the candidates."""
    eta_range: tuple[float, float] = (1.05, 100.0)
    """Smallest and largest eta of the candidates."""
    candidates: tuple[int, int] = (50, 40)
    """Number of alphas and of etas of the candidates."""
    diffuse: bool = True
    """Add diffuse lobes to the candidates, Lambertian and under a coat."""

    def run(self) -> int:
        at_least(1, lobes=self.lobes, alphas=self.alphas, etas=self.etas, candidates=min(self.candidates))
        check_output(self.out, folder=False, option="OUT.json")
        paths = sorted(self.folder.glob("*.binary"))
        if not paths:
            raise InputError(f'there are no files *.binary in "{self.folder}"')
        with expected(ValueError):
            candidates = reflectance.candidates(self.alpha_range, self.eta_range, self.candidates, self.diffuse)
        with expected(OSError):
            lobes, weights, errors = reflectance.reduce(
                ((path.stem, merl_tables.read_merl(path)) for path in paths),
                candidates,
                count=self.lobes,
                alphas=self.alphas,
                etas=self.etas,
                progress=sys.stderr.isatty(),
            )
        with expected(OSError, who="OUT.json"):
            ggx.write_dictionary(self.out, lobes, weights)
        median = reflectance.FitError(*np.median(list(errors.values()), axis=0))
        print("| material | rms | cost |\n|---|---|---|")
        for name, (rms, cost) in {**errors, "(median)": median}.items():
            print(f"| {name} | {rms:.1%} | {cost:.1%} |")
        return 0


Command = Annotated[Fit, subcommand("fit")] | Annotated[Reduce, subcommand("reduce")]


@dataclass(frozen=True, kw_only=True)
class Reflectance:
    """Fit the weights of lobes to measured reflectance, or choose the lobes."""

    command: OmitSubcommandPrefixes[Command]

    def run(self) -> int:
        return self.command.run()
