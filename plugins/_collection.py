"""The guard against Python's garbage collector while Dr.Jit traces a program. The only place that turns it off.

Dr.Jit ends the process in two situations that the collector brings about at random. Each is a matter of scenes that
lie in reference cycles, so that nothing but the collector frees them:

* A kernel holds the same virtual function twice, traced while several objects of its class were registered, and traced
  while there was one. See `docs/troubleshooting.md`.
* A scene is freed while `dr.freeze` records a function.

In a third situation, which the same guard prevents, NVIDIA's assembler refuses a program, and Dr.Jit ends the process:
where a large kernel with function calls keeps what finds no register in shared memory (Dr.Jit 1.5 asks for that).
"""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import drjit as dr
import mitsuba as mi

THREADS = (
    "two threads differentiate at the same time. Dr.Jit looks at the objects of all scenes of a process, so gradients "
    "may be wrong, or errors may be raised, even if each thread has a scene of its own. Use processes, or one thread."
)


class _Collector:
    """Python's garbage collector, off while anybody needs that: it is one for all threads."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.guards = 0
        self.enabled = False
        self.set_aside = False
        #: The thread that came in first; and was the user told that a second one came?
        self.owner = 0
        self.told = False

    def off(self) -> None:
        self._tell()
        with self.lock:
            if not self.guards:
                self.owner = threading.get_ident()
                self.enabled = gc.isenabled()
                gc.disable()
                if self.set_aside and not dr.flag(dr.JitFlag.FreezingScope):
                    gc.unfreeze()
                    self.set_aside = False
            self.guards += 1

    def on(self, raised: bool) -> None:
        with self.lock:
            self.guards -= 1
            if self.guards or not self.enabled:
                return
            # The rest of a function that `dr.freeze` records does not belong to us. Nobody tells when it ends: let the
            # collector go on, but not see what is there already. (If the user has done the same, that ends with it.) An
            # exception ends the recording, and what its traceback holds is to be collected.
            if raised and self.set_aside:
                gc.unfreeze()
                self.set_aside = False
            elif dr.flag(dr.JitFlag.FreezingScope) and not raised:
                gc.freeze()
                self.set_aside = True
            gc.enable()

    def _tell(self) -> None:
        """Say once that threads mix."""
        with self.lock:
            mixed = self.guards and threading.get_ident() != self.owner and not self.told
            self.told |= bool(mixed)
        if mixed:
            mi.Log(mi.LogLevel.Warn, THREADS)

    def collect(self) -> None:
        with self.lock:
            if self.enabled and self.guards == 1:
                gc.collect()


_collector = _Collector()


def _on_gpu() -> bool:
    return (mi.variant() or "").startswith("cuda")


@contextmanager
def no_collection() -> Iterator[None]:
    """Keep Python's garbage collector from running. What is traced in here is also evaluated in here.

    All integrators of Rimlight, its references and its fits do this by themselves. Around steps of your own that use
    other integrators of Mitsuba, or `dr.freeze`, it prevents that Dr.Jit ends the process, as the documentation
    explains under "Troubleshooting"::

        for i in range(100):
            with rimlight.no_collection():
                step(i)

    `@rimlight.no_collection()` does the same for all calls of a function. Put it around a step, not around the loop:
    the collector runs between the steps whenever Python finds that due. It is off for all threads of the process as
    long as one is in here. Objects that no cycle holds are freed at any time, as ever.

    What Dr.Jit has scheduled before, and its pending side effects, are evaluated first, and those from in here at the
    end, unless an exception is raised. In a function that `dr.freeze` records, what exists when it ends is kept from
    the collector until the next call outside of one. (A `gc.freeze()` of yours ends then, too.)
    """
    # The generator that Python has made for this function is an allocation, and with it comes the collection that is
    # due, if one is. That costs a loop of short steps nothing, where `gc.collect()` in each would be most of its time.
    _collector.off()
    raised = True
    try:
        _evaluate()
        with dr.scoped_set_flag(dr.JitFlag.SpillToSharedMemory, False) if _on_gpu() else nullcontext():
            yield
            _evaluate()
        raised = False
    finally:
        _collector.on(raised)


def collect_before() -> None:
    """Collect everything, as the first thing that is done within the guard. Tens of milliseconds: not in each step.

    Does nothing where the user has turned the collector off, or is within a guard of their own.
    """
    _collector.collect()


def _evaluate() -> None:
    # In a loop or a virtual function that is being recorded, nothing can be.
    if not dr.flag(dr.JitFlag.SymbolicScope):
        dr.eval()
