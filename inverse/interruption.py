"""Ctrl-C, which in the midst of a step may leave Dr.Jit in the midst of a loop."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def listening(pressed: Callable[[], object]) -> Iterator[None]:
    """Within it, Ctrl-C only calls this function, once; pressed again, it interrupts at once. In other threads than the
    main one, nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def press(number: int, frame: Any) -> None:
        signal.signal(signal.SIGINT, previous)
        pressed()

    previous = signal.signal(signal.SIGINT, press)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def dask_setup(worker: Any) -> None:
    """Called by Dask as a worker of this machine begins. Ctrl-C reaches all processes of a terminal; what it means for
    the fit, the process of the fit decides alone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
