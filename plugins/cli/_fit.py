"""`rimlight fit`: its options are those of a problem, whose defaults come from the TOML file."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from tyro.conf import Positional, arg

from rimlight import inverse
from rimlight.inverse import Free, Problem
from rimlight.inverse import problem as problems
from rimlight.loading import InputError, expected

from ._loading import at_least, check_output, one_cluster, show_warnings

#: Of more views than so, their mean is printed; the report has all.
FEW_VIEWS = 4

#: Code of a command that Ctrl-C ended.
INTERRUPTED = 130

#: What is shown by --help before there is a file.
EXAMPLE = Problem(scene=Path("scene.xml"), free=(Free(key=("shape.vertex_positions",), kind="pose"),))


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Fit pose, material, light or shape to pictures, as described by a TOML file."""

    kind: Positional[Literal["pose", "material", "light", "shape", "joint"]]
    """joint optimises every free parameter. The others optimise one kind and keep the other parameters fixed."""
    config: Annotated[Positional[Path], arg(metavar="CONFIG.TOML")]
    """File that describes the problem. Each of its entries is also an option of this command."""
    out: Path
    """Folder for the report, the result and the checkpoints."""
    resume: bool = False
    """Continue from the checkpoint in that folder."""
    workers: int = 0
    """Number of processes of this machine that share the work. 0: this process does all of it."""
    cluster: str | None = None
    """Address of the scheduler of a Dask cluster, such as tcp://10.0.0.1:8786, whose workers share the work."""
    seeds: int = 1
    """Number of random seeds. With several, each has a fit and a folder of its own, and workers share whole fits."""
    watch: bool = False
    """Show the report while the fit runs, on a page that only this machine can open. Its address is printed."""
    tensorboard: bool = False
    """Write a log for TensorBoard into the folder."""
    problem: Annotated[Problem, arg(name="")] = EXAMPLE

    def run(self) -> int:
        at_least(0, workers=self.workers)
        at_least(1, seeds=self.seeds)
        one_cluster(self.workers, self.cluster)
        check_output(self.out, folder=True)
        if not self.resume and any(self.out.glob("seed_*/checkpoint.npz" if self.seeds > 1 else "checkpoint.npz")):
            raise InputError(f'--out: "{self.out}" holds a fit already; add --resume, or name another folder')
        problem = self.problem
        if self.kind != "joint":
            free = tuple(f for f in problem.free if f.kind == self.kind)
            if not free:
                kinds = ", ".join(sorted({f.kind for f in problem.free}))
                raise InputError(f'nothing of the kind "{self.kind}" is free in "{self.config}", only {kinds}')
            problem = dataclasses.replace(problem, free=free)
        show_warnings()
        if self.seeds > 1:
            return self._several(problem)
        with ExitStack() as stack, expected(OSError):
            executor = None
            if self.cluster is not None or self.workers:
                executor = stack.enter_context(inverse.Cluster(problem, self.cluster or self.workers))
            fit = inverse.Fit(
                problem, out=self.out, resume=self.resume, executor=executor, tensorboard=self.tensorboard
            )
            if self.watch:
                watch = stack.enter_context(inverse.Watch(fit, title=self.config.stem))
                print(f"watch: {watch.url}", flush=True)
            found = fit.run()
            print("\n".join(_said(found)))
            inverse.write(self.out, found, title=self.config.stem)
        print(f"report: {self.out / 'report.html'}")
        return _code(found)

    def _several(self, problem: Problem) -> int:
        """Fits of several seeds, on workers or here."""
        if self.watch or self.tensorboard:
            raise InputError("--seeds runs several fits; --watch and --tensorboard show one")
        seeds = range(problem.seed, problem.seed + self.seeds)
        alike = problems.relative_to(problem, Path.cwd())
        jobs = [(dataclasses.replace(alike, seed=seed), self.out.resolve() / f"seed_{seed}") for seed in seeds]
        worst = 0
        with ExitStack() as stack, expected(OSError):
            if self.cluster is not None or self.workers:
                workers = stack.enter_context(inverse.Workers(self.cluster or self.workers, problem.threads))
                blocks = workers.run(
                    _whole, self.config.stem, None, [(i / len(jobs), job) for i, job in enumerate(jobs)]
                )
                found = (outcome for _, of_block in blocks for outcome in of_block)
            else:
                found = (outcome for job in jobs for outcome in _whole(self.config.stem, None, [job], progress=True))
            for seed, (code, lines) in zip(seeds, found, strict=True):
                print("\n".join(f"seed {seed}: {line}" for line in lines), flush=True)
                worst = max(worst, code)
                if code == INTERRUPTED:
                    break
        return worst


def _whole(
    title: str, _: None, jobs: Sequence[tuple[Problem, Path]], progress: bool = False
) -> list[tuple[int, list[str]]]:
    """Exit codes, and lines for people, of whole fits. What has begun, maybe on a worker that was lost, goes on.

    progress : show a bar for each?
    """
    outcomes = []
    for problem, out in jobs:
        found = inverse.fit(problem, out=out, resume=(out / "checkpoint.npz").exists(), progress=progress)
        inverse.write(out, found, title=f"{title}, seed {problem.seed}")
        outcomes.append((_code(found), [*_said(found), f"report: {out / 'report.html'}"]))
    return outcomes


def _code(found: inverse.Result) -> int:
    """Of the command."""
    return {"finished": 0, "out of time": 0, "interrupted": INTERRUPTED}.get(found.status, 1)


def _said(found: inverse.Result) -> list[str]:
    """Of a result, for people."""
    said = [f"{found.status}: {len(found.losses)} steps in {found.seconds:.1f} s"]
    for label, errors in found.errors.items():
        said.append(f"  {label}: {errors[0]:.4g} -> {errors[-1]:.4g}")
    count = len(found.measures)
    of_views = (
        {f"view {i}": [i] for i in range(count)} if count <= FEW_VIEWS else {f"mean of {count} views": range(count)}
    )
    for name, views in of_views.items():
        for label in found.measures[0]:
            before, after = np.mean([m[label] for i in views if label in (m := found.measures[i])], axis=0)
            said.append(f"  {name}, {label}: {before:.4g} -> {after:.4g}")
        if found.floors:
            noise = np.mean([found.floors[i] for i in views])
            said.append(f"  {name}, root mean square error at the truth (noise): {noise:.4g}")
    if found.skipped:
        said.append(f"  {found.skipped} steps were left out: a number would not have been finite")
    for name in found.silent:
        said.append(f'  "{name}" has no influence on the pictures')
    return said


def command(argv: Sequence[str]) -> Any:
    """`Fit`, with the problem of the TOML file that the arguments name as the default of its options."""
    files = [a for a in argv if a.lower().endswith(".toml") and not a.startswith("-")]
    if not files or {"-h", "--help"} & set(argv):
        return Fit
    with expected(ValueError, OSError):
        if not os.path.exists(files[0]):
            raise InputError(f'there is no file "{files[0]}"')
        problem = inverse.read(files[0])
    annotation = Annotated[Problem, arg(name="")]
    made = dataclasses.make_dataclass(
        "Fit",
        [("problem", annotation, problem)],
        bases=(Fit,),
        frozen=True,
        kw_only=True,
        namespace={"__doc__": Fit.__doc__},
    )
    return made


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Run the fits of Li et al. 2018 (figures 1, 6 and 10), and six of ours (jumps, lampshade, caustic,
    caustic_shape). Writes a report of each and prints a table of all."""

    figure: Positional[
        Literal["fig1", "fig6a", "fig6b", "fig6c", "fig6d", "fig6e", "fig6f", "fig6", "fig10"]
        | Literal["pot_in_mirror", "ball_of_glass", "box_in_sand", "jumps", "lampshade", "caustic"]
        | Literal["caustic_shape", "all"]
    ]
    """Figure to reproduce, or one of its parts, or all."""
    out: Path
    """Folder for the reports. Fits that are in it already are not repeated."""
    seeds: int = 1
    """Number of random seeds. Each fit runs once for each seed."""
    peer: bool = False
    """Run each fit also with Mitsuba's prb_projective, for as long as Rimlight's took."""
    workers: int = 0
    """Number of processes of this machine, each of which runs one fit at a time. 0: this process runs all of them."""
    cluster: str | None = None
    """Address of the scheduler of a Dask cluster, such as tcp://10.0.0.1:8786, whose workers run the fits."""

    def run(self) -> int:
        from rimlight.inverse import reproduce

        at_least(1, seeds=self.seeds)
        at_least(0, workers=self.workers)
        one_cluster(self.workers, self.cluster)
        check_output(self.out, folder=True)
        show_warnings()
        with ExitStack() as stack, expected(OSError):
            workers = None
            if self.cluster is not None or self.workers:
                workers = stack.enter_context(inverse.Workers(self.cluster or self.workers))
            outcomes = reproduce.reproduce(
                self.figure, self.out, seeds=range(self.seeds), peer=self.peer, workers=workers
            )
        print("\n".join(reproduce.table(outcomes)))
        return 0
