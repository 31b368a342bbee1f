"""`rimlight ps`: photometric stereo, and data sets for it."""

from __future__ import annotations

import dataclasses
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import drjit as dr
import numpy as np
from tyro.conf import OmitSubcommandPrefixes, Positional, arg, subcommand

from rimlight import inverse
from rimlight.edge_sampling.refusals import Refusal
from rimlight.exr import read_exr, remove_left_over
from rimlight.inverse.interruption import listening
from rimlight.inverse.photometric_stereo import (
    calibration,
    cost,
    dataset,
    full_size,
    inspection,
    inspection_page,
    output,
    reconstruction,
    report,
    simulation,
)
from rimlight.loading import InputError, expected, use_variant

from ._loading import at_least, check_output, one_cluster, show_warnings

#: Of a run that has not finished.
CHECKPOINT = "checkpoint.npz"


@dataclass(frozen=True, kw_only=True)
class Run:
    """Reconstruct normals, depth and reflectance of a data set, or of several."""

    folders: Annotated[Positional[tuple[Path, ...]], arg(metavar="FOLDER [FOLDER ...]")]
    """Folders with images, lights and a mask, in the layout of DiLiGenT."""
    out: Path
    """Folder for the results and the checkpoint. Of several data sets, each has a folder of its name in it."""
    resume: bool = False
    """Continue from the checkpoint in that folder."""
    images: int = 0
    """Use only this many of the images, spread evenly over their list. 0: all."""
    reduce: int = 1
    """Divide width and height of the images by this number as they are read: 2 takes a quarter of the memory."""
    full_size: bool = False
    """With --reduce: fit the normals of the full images as well, from the surface that was found, some rows at a time.
    They are written to the folder full_size."""
    variant: str = "llvm_ad_rgb"
    """Variant of Mitsuba."""
    threads: int = 0
    """Threads of Dr.Jit. 0: one for each core. With 1, repeated runs have the same result, bit by bit."""
    workers: int = 0
    """Number of processes of this machine, each of which reconstructs one data set at a time. 0: this process
    reconstructs all."""
    cluster: str | None = None
    """Address of the scheduler of a Dask cluster, such as tcp://10.0.0.1:8786, whose workers reconstruct."""
    options: Annotated[reconstruction.Options, arg(name="")] = field(default_factory=reconstruction.Options)

    def run(self) -> int:
        at_least(0, images=self.images, threads=self.threads, workers=self.workers)
        at_least(1, reduce=self.reduce)
        if self.full_size and self.reduce == 1:
            raise InputError("--full-size: normals are those of the full images already; it goes with --reduce 2, say")
        one_cluster(self.workers, self.cluster)
        if not self.folders:
            raise InputError("name a folder with images, lights and a mask")
        show_warnings()
        elsewhere = self.cluster or self.workers
        if len(self.folders) > 1 or elsewhere:
            return self._several(elsewhere)
        check_output(self.out, folder=True)
        code, lines = self.one()
        for line in lines:
            print(line)
        return code

    def _several(self, elsewhere: str | int) -> int:
        """elsewhere : workers that reconstruct them."""
        names = [folder.resolve().name for folder in self.folders]
        if len(set(names)) < len(names):
            raise InputError(f"data sets need different names, got {', '.join(names)}")
        jobs = [
            dataclasses.replace(self, folders=(folder.resolve(),), out=self.out.resolve() / name)
            for folder, name in zip(self.folders, names, strict=True)
        ]
        for job in jobs:
            check_output(job.out, folder=True)
            if not self.resume:
                job._done()
        worst = 0
        with ExitStack() as stack, expected(OSError):
            if elsewhere:
                workers = stack.enter_context(inverse.Workers(elsewhere, self.threads or None))
                items = [(i / len(jobs), dataclasses.replace(job, threads=0)) for i, job in enumerate(jobs)]
                blocks = workers.run(_attempts, None, None, items)
                found = (outcome for _, of_block in blocks for outcome in of_block)
            else:
                found = (outcome for job in jobs for outcome in _attempts(None, None, [job]))
            for name, (code, lines) in zip(names, found, strict=True):
                print("\n".join(f"{name}: {line}" for line in lines), flush=True)
                worst = max(worst, code)
        return worst

    @property
    def folder(self) -> Path:
        return self.folders[0]

    def one(self) -> tuple[int, list[str]]:
        """Exit code, and lines for people, of one data set."""
        if self._done():
            return 0, [f"finished already: {self.out / 'report.html'}"]
        if self.out.resolve() == self.folder.resolve():
            raise InputError(f'--out: "{self.out}" is the folder of the images; name another one')
        use_variant(self.variant)
        if self.threads:
            dr.set_thread_count(self.threads)
        with expected(OSError, ValueError):
            self._check_memory()
            data = dataset.read(self.folder, images=self.images, reduce=self.reduce)
            truth = _true_depth(self.folder)
        with expected(OSError):
            return self._reconstruct(data, truth)

    def has_begun(self) -> bool:
        return (self.out / CHECKPOINT).exists() or (self.out / "metadata.json").exists()

    def _done(self) -> bool:
        """Is there nothing to resume, since the run has finished? Refuses a folder that holds something else."""
        there = (self.out / CHECKPOINT).exists()
        if not self.resume:
            if there:
                raise InputError(f'--out: "{self.out}" holds a run already; add --resume, or name another folder')
            if (self.out / "metadata.json").exists():
                raise InputError(f'--out: "{self.out}" holds a result already; remove it, or name another folder')
            return False
        for name in output.NUMBERS:
            remove_left_over(self.out / name)
        if there:
            return False
        if output.status(self.out) != "finished":
            raise InputError(f'there is no checkpoint in "{self.out}" to resume from; leave out --resume')
        return True

    def _check_memory(self) -> None:
        setup = dataset.read_setup(self.folder, images=self.images)
        pixels, images = int(setup.mask.sum()), len(setup.names)
        if self.full_size:
            full_size.check_space(setup, self.out)
        near = setup.near or setup.away is not None
        needed = cost.memory(pixels, images, self.options, near=near, reduce=self.reduce)
        if needed > (there := cost.available_memory()):
            raise InputError(
                f"{images} images of {pixels} pixels would take {needed / 2**30:.1f} GiB of memory, "
                f"{there / 2**30:.1f} GiB are available; use --reduce {2 * self.reduce}, with --full-size if need be, "
                "fewer of the --images, smaller --resolutions, or --no-near-lights"
            )

    def _reconstruct(self, data: dataset.Dataset, truth: np.ndarray | None) -> tuple[int, list[str]]:
        found: reconstruction.Result | None = None
        write_numbers = partial(output.write_numbers, self.out, options=self.options, truth=truth, reduce=self.reduce)
        pressed: list[bool] = []

        def after(result: reconstruction.Result) -> None:
            nonlocal found
            found = output.snapshot(result)
            write_numbers(found, status="running")
            if pressed:
                raise KeyboardInterrupt

        status = "finished"
        try:
            with listening(lambda: pressed.append(True)):
                found = reconstruction.reconstruct(
                    data,
                    self.options,
                    progress=_is_watched(),
                    after=after,
                    checkpoint=self.out / CHECKPOINT,
                    resume=self.resume,
                )
        except KeyboardInterrupt:
            if found is None:
                raise
            status = "interrupted"
            print("rimlight: interrupted; writing the best that was found; --resume goes on", file=sys.stderr)
        write_numbers(found, status=status)
        output.write_pictures(self.out, found)
        title = f"Photometric stereo: {self.folder.resolve().name}"
        write_report = partial(report.write, self.out, found, self.options, title=title, status=status, truth=truth)
        write_report()
        lines = [f"{status}: {len(found.history)} alternations in {found.seconds:.1f} s"]
        if status == "finished":
            # As long as there is a checkpoint, --resume goes on: after a disk was full, say.
            try:
                lines += self._full_size(found, write_report) if self.full_size else []
                (self.out / CHECKPOINT).unlink(missing_ok=True)
            except KeyboardInterrupt:
                status = "interrupted"
                print("rimlight: interrupted before the full images were fitted; --resume does it", file=sys.stderr)
        lines += [f"report: {self.out / 'report.html'}"]
        if (error := output.error_of_depth(found, truth)) is not None:
            lines += [f"mean error of depth {error:.3g} {'pixels' if data.camera is None else ''}".rstrip()]
        if found.error is not None:
            lines += [f"mean angular error {found.error:.2f} deg"]
        return (0 if status == "finished" else 130), lines

    def _full_size(self, found: reconstruction.Result, write_report: Callable[..., None]) -> list[str]:
        """Normals of the full images, and what to say of them."""
        options = {"reduce": self.reduce, "images": self.images, "progress": _is_watched()}
        full = full_size.find(self.folder, self.out, found, self.options, **options)
        output.write_full_size(self.out / "full_size", full, found)
        write_report(full=full)
        said = "" if full.error is None else f", mean angular error {full.error:.2f} deg"
        return [f"normals of {len(full.normals)} pixels: {self.out / 'full_size'}{said}"]


def _attempts(kept: None, shared: None, jobs: Sequence[Run]) -> list[tuple[int, list[str]]]:
    """What `Run.one` says of several data sets. What has begun, maybe on a worker that was lost, goes on; an error of
    one does not stop the others."""
    found = []
    for job in jobs:
        try:
            found.append(dataclasses.replace(job, resume=job.has_begun()).one())
        except (InputError, Refusal) as error:
            found.append((2, [str(error)]))
    return found


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Make a data set whose true shape is known, by path tracing."""

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder for the data set."""
    variant: str = "llvm_ad_rgb"
    """Variant of Mitsuba."""
    options: Annotated[simulation.Options, arg(name="")] = field(default_factory=simulation.Options)

    def run(self) -> int:
        check_output(self.out, folder=True, option="OUT")
        if (self.out / dataset.NAMES).exists():
            raise InputError(f'OUT: "{self.out}" holds a data set already; remove it, or name another folder')
        use_variant(self.variant)
        with expected(OSError):
            data, depth = simulation.simulate(self.options, progress=sys.stderr.isatty())
            simulation.write(self.out, data, depth, self.options)
        pixels, K, _ = data.values.shape
        print(f"{K} images, {pixels} pixels of the mask")
        return 0


@dataclass(frozen=True, kw_only=True)
class Calibrate:
    """Find the directions of lights from pictures of a ball; a matte one also tells their intensities."""

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """Folder with pictures of a ball, one for each light. The lights are written into it."""
    ball: Path
    """Picture that is the mask of the ball."""
    kind: Literal["chrome", "matte"]
    """chrome: the ball is a mirror. matte: it is Lambertian, which also tells the intensities of the lights."""

    def run(self) -> int:
        use_variant("llvm_ad_rgb")
        with expected(OSError):
            directions, intensities = calibration.calibrate(self.folder, self.ball, self.kind)
        files = [dataset.DIRECTIONS] + [dataset.INTENSITIES] * (intensities is not None)
        print(f"{len(directions)} lights: {', '.join(str(self.folder / name) for name in files)}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Inspect:
    """Check a data set before it is reconstructed: print a table and warnings, and write a page with pictures."""

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """Folder with images, lights and a mask, in the layout of DiLiGenT."""
    out: Path = Path("inspection.html")
    """HTML page to write."""

    def run(self) -> int:
        check_output(self.out, folder=False)
        use_variant("llvm_ad_rgb")
        with expected(OSError):
            found = inspection.inspect(self.folder)
            inspection_page.write(self.out, found, title=f"Data set: {self.folder.resolve().name}")
        for name, value in inspection.table(found):
            print(f"{name:24}{value}")
        for text in inspection.warnings(found):
            print(f"look at this: {text}")
        print(f"page: {self.out}")
        return 0


Command = (
    Annotated[Run, subcommand("run")]
    | Annotated[Inspect, subcommand("inspect")]
    | Annotated[Simulate, subcommand("simulate")]
    | Annotated[Calibrate, subcommand("calibrate")]
)


@dataclass(frozen=True, kw_only=True)
class Ps:
    """Photometric stereo: find shape and reflectance from images under many lights."""

    command: OmitSubcommandPrefixes[Command]

    def run(self) -> int:
        return self.command.run()


def _is_watched() -> bool:
    """Is there someone to show progress to?"""
    return sys.stderr.isatty() and threading.current_thread() is threading.main_thread()


def _true_depth(folder: Path) -> np.ndarray | None:
    """(H, W), if there is a file."""
    if not (folder / simulation.TRUE_DEPTH).is_file():
        return None
    layers, _ = read_exr(folder / simulation.TRUE_DEPTH)
    return next(iter(layers.values()))[..., 0]
