"""Processes of a Dask cluster that do work for a fit, on this machine or on many.

Dask connects the processes, carries functions and arrays, and starts a process anew that dies. Added here: one task at
a time in a process, whose threads are its share of those of its machine; work belongs to a worker, which remembers what
it needs for it; and what a lost worker had to do is divided among the others.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import drjit as dr
import mitsuba as mi

import rimlight
from rimlight.edge_sampling.refusals import InputError, Refusal
from rimlight.loading import one_line

from . import interruption

log = logging.getLogger(__name__)

#: Seconds between two looks at who is there, while work is being done.
POLL = 1.0

#: Seconds without a sign of life after which a worker counts as lost. Busy ones give signs, too.
SILENT = 60.0

#: Seconds in which a scheduler must answer. One that is frozen, on a machine that is not, never does.
ANSWER = 60.0

#: Seconds to wait for the first worker, or for a new one after all were lost.
PATIENCE = 120.0

#: Seconds for which Dask tries to reach a scheduler, at first, and again when the connection broke.
CONNECT = 20.0

#: How often work is given out whose workers were lost.
TRIES = 5

#: Seconds that others are given after a worker was lost, who may wait for what it held.
GRACE = 30.0

#: What to do when the scheduler is lost.
AGAIN = "start a cluster, and resume"

#: Parts that are added up by one task.
FAN = 8


class Lost(Refusal):
    """Workers or their scheduler are lost for good. The text is one line that says what to do."""


@dataclass(frozen=True)
class Worker:
    """address : of a worker. name : for the order of all of them, which survives a restart. share : how many workers
    its machine has. silent : seconds since its last sign of life."""

    address: str
    name: str
    share: int
    silent: float


@dataclass(frozen=True)
class Failure:
    """What a worker raised, in place of a result."""

    error: Exception


@dataclass(frozen=True)
class Block:
    """What a worker has to do: numbers of items, its address, and the future of the result."""

    numbers: list[int]
    address: str
    future: Any


class Workers:
    """The workers of a Dask cluster.

    cluster : how many processes to start on this machine; or the address of a scheduler, such as
        "tcp://10.0.0.1:8786"; or a cluster of one of Dask's deployers, or a client of one.
    threads : of each process. Default: its share of the cores of its machine.

    Raises
    ------
    InputError : there is no such cluster, or Dask is not installed.
    """

    def __init__(self, cluster: int | str | Any, threads: int | None = None):
        try:
            from distributed import Client, LocalCluster
        except ImportError:
            raise InputError("workers need the package distributed: pip install 'rimlight[cluster]'") from None
        if cluster is None or isinstance(cluster, bool | float):
            raise InputError(
                f"a cluster is a number of processes, the address of a scheduler, or one of Dask, got {cluster!r}"
            )
        if isinstance(cluster, int) and cluster < 1:
            raise InputError(f"the number of workers must be >= 1, got {cluster}")
        self.threads = threads
        self._address = "an unknown place"
        self._last: tuple[float, list[Worker]] | None = None  # when was looked for workers, and who was there
        self._kept: tuple[list[str], Any, Any] | None = None  # workers that hold a thing, and their future
        self._mine: list[Any] = []
        if isinstance(cluster, int):
            cluster = LocalCluster(
                n_workers=cluster,
                threads_per_worker=1,
                dashboard_address=":0",
                silence_logs=logging.CRITICAL,
                preload=[interruption.__name__],
            )
            self._mine.append(cluster)
        try:
            if isinstance(cluster, Client):
                self.client = cluster
            else:
                self.client = Client(cluster, timeout=CONNECT, set_as_default=False)
                self._mine.insert(0, self.client)
        except (OSError, ValueError, TypeError) as error:
            raise InputError(f'no cluster at "{cluster}": {error}') from None
        if self.client.scheduler is not None:
            self._address = self.client.scheduler.address

    def close(self) -> None:
        """Close what was opened here. What was given stays as it was."""
        for opened in self._mine:
            with suppress(asyncio.TimeoutError):  # of a scheduler that is frozen
                opened.close()

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    # ---------------------- Work ----------------------

    def run(
        self,
        function: Callable[[Any, Any, list], Any],
        kept: Any,
        shared: Any,
        items: Sequence[tuple[float, Any]],
        combine: Callable[[list, bool], Any] | None = None,
    ) -> list[tuple[list[int], Any]]:
        """Results of `function(kept, shared, some items)`, of all items, some at a time, each with their numbers.

        function : pure, so that it can be called again.
        kept : the same object in many runs, such as the text of a problem: it travels to each worker once. shared : of
            this run. Both travel from here to one worker, and from worker to worker.
        items : each with its place, in [0, 1): it belongs to worker number `place * workers`, as long as that one
            lives. What a lost worker had to do is divided among the others.
        combine : makes one result of several, and is told whether that is the last one. They are combined on the
            workers, in a tree whose order is fixed; one result is returned.

        Raises
        ------
        Lost : workers were lost too often, or there are none. What a function raised is raised here.
        """
        why = ""
        for _ in range(TRIES):
            given: list[Any] = []
            try:
                blocks = self._compute(function, kept, shared, items, given)
                there = {block.address for block in blocks}
                if combine is not None:
                    blocks = self._combine(combine, blocks, given)
                found = self._fetch(blocks, there)
                if found is not None:
                    return [(block.numbers, result) for block, result in zip(blocks, found, strict=True)]
                why = "a worker was lost"
            except (OSError, CancelledError, self._killed()) as error:
                why = one_line(error)
            self._last = self._kept = None
            self._cancel(given)
            log.warning("%s; the step is done again", why)
        raise Lost(f"workers were lost {TRIES} times in a row, the last time: {why}; have they enough memory?")

    def _compute(
        self,
        function: Callable[[Any, Any, list], Any],
        kept: Any,
        shared: Any,
        items: Sequence[tuple[float, Any]],
        given: list[Any],
    ) -> list[Block]:
        """Blocks that are done, in the order of their items. given : collects futures."""
        done: list[Block] = []
        places = {i: place for i, (place, _) in enumerate(items)}
        for _ in range(TRIES):
            workers = self._wait_for_workers()
            kept_there = self._held(workers, kept)
            owners = {i: int(place * len(workers)) for i, place in places.items()}
            # A future among the arguments stands for its result.
            here = self._submit(given, [workers[min(owners.values())].address], _same, (_identity(), shared))
            for owner, block in groupby(sorted(owners, key=lambda i: (owners[i], i)), key=owners.__getitem__):
                numbers, worker = list(block), workers[owner]
                some = [items[i][1] for i in numbers]
                task = self.threads, worker.share, function, kept_there, here, some
                done.append(Block(numbers, worker.address, self._submit(given, [worker.address], _perform, *task)))
            lost = self._wait_for(done, again=len(places) < len(items))
            if not lost:
                return sorted(done, key=lambda block: block.numbers)
            log.warning("a worker was lost; its part of the step is done again")
            self._last = self._kept = None
            self._cancel([block.future for block in lost])
            done = [block for block in done if block not in lost]
            again = sorted(i for block in lost for i in block.numbers)
            places = {i: k / len(again) for k, i in enumerate(again)}
        raise Lost(f"workers were lost {TRIES} times in a step; have they enough memory?")

    def _submit(self, given: list[Any], where: Sequence[str], task: Callable, *arguments: Any) -> Any:
        given.append(self.client.submit(task, *arguments, pure=False, workers=where))
        return given[-1]

    def _cancel(self, futures: Sequence[Any]) -> None:
        """If the scheduler can be reached."""
        with suppress(OSError, CancelledError, asyncio.TimeoutError):
            self.client.sync(
                lambda: self.client.cancel(futures, asynchronous=True, force=True), callback_timeout=10 * POLL
            )

    def _wait_for(self, blocks: Sequence[Block], again: bool) -> list[Block]:
        """Wait until all are done, or some are lost: these. again : was one lost before? Then others may wait for what
        it held."""
        from distributed import wait

        began = time.monotonic()
        while True:
            with suppress(asyncio.TimeoutError), self.client.as_current():
                wait([block.future for block in blocks], timeout=POLL)
                return []
            addresses = {worker.address for worker in self.present()}
            lost = {block.address for block in blocks} - addresses
            keys = [block.future.key for block in blocks]
            waiting = self._ask(_waiting, keys=keys) if lost else []
            late = again and time.monotonic() - began > GRACE
            if lost or late:
                return [
                    block
                    for block in blocks
                    if block.address in lost or block.future.key in waiting or (late and not block.future.done())
                ]

    def _combine(self, combine: Callable[[list, bool], Any], blocks: Sequence[Block], given: list[Any]) -> list[Block]:
        """One block of all, made by those who have the parts."""
        where = sorted({block.address for block in blocks})
        futures, last = [block.future for block in blocks], False
        while not last:
            last = len(futures) <= FAN
            groups = [futures[i : i + FAN] for i in range(0, len(futures), FAN)]
            futures = [self._submit(given, where, _combined, combine, group, last) for group in groups]
        return [Block(sorted(i for block in blocks for i in block.numbers), "", futures[0])]

    def _fetch(self, blocks: Sequence[Block], there: set[str]) -> list[Any] | None:
        """The results. None: a worker was lost that may have had one of them. there : addresses of all of these."""
        found = []
        for block in blocks:
            patience = POLL
            while True:
                with suppress(asyncio.TimeoutError):
                    found.append(block.future.result(timeout=patience))
                    break
                patience *= 2  # what is long in coming begins anew
                if not there <= {worker.address for worker in self.present()}:
                    return None
        return _checked(found)

    def _held(self, workers: Sequence[Worker], thing: Any) -> Any:
        """The future of a thing that is kept, as long as the same workers are there."""
        addresses = [worker.address for worker in workers]
        if self._kept is None or self._kept[0] != addresses or self._kept[1] is not thing:
            # As the result of a task: scattered data would be gone with its worker.
            self._kept = addresses, thing, self.client.submit(_same, thing, pure=False, workers=addresses)
        return self._kept[2]

    # ---------------------- Who is there ----------------------

    def present(self) -> list[Worker]:
        """Workers that have given a sign of life. Lost : the scheduler is gone."""
        return [worker for worker in self._ask(_list_workers) if worker.silent < SILENT]

    def _ask(self, function: Callable[..., Any], **arguments: Any) -> Any:
        """What a function says that is called on the scheduler, also if the connection breaks for a moment.

        Raises
        ------
        Lost : the scheduler is gone, or frozen.
        """
        while self.client.status in ("running", "connecting"):
            if self.client.status == "running":
                began = time.monotonic()
                with suppress(OSError, CancelledError, asyncio.TimeoutError):
                    return self.client.run_on_scheduler(function, callback_timeout=ANSWER, **arguments)
                if time.monotonic() - began >= ANSWER:
                    raise Lost(f"the scheduler at {self._address} has not answered for {ANSWER:.0f} s; {AGAIN}")
            time.sleep(POLL / 4)  # Dask connects again, or gives up
        raise Lost(f"the scheduler at {self._address} is gone; {AGAIN}")

    def _wait_for_workers(self) -> list[Worker]:
        began = time.monotonic()
        if self._last and began - self._last[0] < POLL:
            return self._last[1]
        while not (found := self.present()):
            if time.monotonic() - began > PATIENCE:
                raise Lost(f"the cluster has had no worker for {PATIENCE:.0f} s; start some, and resume")
            time.sleep(POLL / 4)
        self._last = began, found
        return found

    @staticmethod
    def _killed() -> type[Exception]:
        from distributed import KilledWorker

        return KilledWorker


def _checked(results: Sequence[Any]) -> list[Any]:
    for result in results:
        if isinstance(result, Failure):
            raise result.error
    return list(results)


# ------------------------------------------------------------------ on the scheduler


def _list_workers(dask_scheduler: Any) -> list[Worker]:
    states = list(dask_scheduler.workers.values())
    hosts = [state.host for state in states]
    now = time.time()
    found = [Worker(s.address, str(s.name), hosts.count(s.host), now - s.last_seen) for s in states]
    return sorted(found, key=lambda worker: worker.name)


def _waiting(dask_scheduler: Any, keys: Sequence[str]) -> list[str]:
    """Of tasks, those whose arguments nobody has: a worker that is lost had them."""
    tasks = dask_scheduler.tasks
    return [key for key in keys if key in tasks and tasks[key].state in ("waiting", "no-worker", "released")]


# ------------------------------------------------------------------ on workers


def _same(thing: Any) -> Any:
    return thing


@dataclass(frozen=True)
class Identity:
    """host, process : where it is. versions : of what computes."""

    host: str
    process: int
    versions: Mapping[str, str]


def _identity() -> Identity:
    versions = {"Rimlight": rimlight.__version__, "Mitsuba": mi.__version__, "Dr.Jit": dr.__version__}
    return Identity(socket.gethostname(), os.getpid(), versions)


def _refuse(other: Identity) -> None:
    """Raises Refusal: this worker cannot work for the process that asks."""
    here = _identity()
    for name, version in here.versions.items():
        if version != other.versions[name]:
            raise Refusal(f"this worker has {name} {version}, the fit {other.versions[name]}; install the same")
    if (here.host, here.process) == (other.host, other.process):
        raise Refusal(
            "a worker is a thread of the fit's own process; Dr.Jit needs processes, such as "
            "LocalCluster(processes=True)"
        )


#: The one thread of this process that renders, however many Dask gives it; and how many threads of Dr.Jit work for it.
_renders: tuple[ThreadPoolExecutor, int] | None = None


def _thread(threads: int | None, share: int) -> ThreadPoolExecutor:
    """How many threads work for it is decided once: what Dr.Jit has recorded ends the process if it is replayed with
    another number. Raises Refusal: the fit asks for another number."""
    from dask.system import CPU_COUNT  # what the control group of this process allows

    global _renders
    if _renders is None:
        count = min(threads or max(CPU_COUNT // share, 1), CPU_COUNT)
        dr.set_thread_count(count)
        _renders = ThreadPoolExecutor(1, thread_name_prefix="rimlight"), count
    pool, count = _renders
    if threads is not None and min(threads, CPU_COUNT) != count:
        raise Refusal(
            f"this worker has {count} threads since its first task, and the fit asks for {threads}; restart it"
        )
    return pool


def _perform(
    threads: int | None,
    share: int,
    function: Callable[[Any, Any, list], Any],
    kept: Any,
    here: tuple[Identity, Any],
    items: list,
) -> Any:
    """Do a task on a worker. share : how many workers this machine has."""
    other, shared = here
    try:
        _refuse(other)
        return _thread(threads, share).submit(function, kept, shared, items).result()
    except (InputError, Refusal, OSError) as error:
        kind = next(kind for kind in (InputError, Refusal, OSError) if isinstance(error, kind))
        return Failure(kind(f"{error} (said by the worker {socket.gethostname()}, process {os.getpid()})"))
    except Exception as error:
        return Failure(error)


def _combined(combine: Callable[[list, bool], Any], parts: list[Any], last: bool) -> Any:
    failed = [part for part in parts if isinstance(part, Failure)]
    return failed[0] if failed else combine(parts, last)
