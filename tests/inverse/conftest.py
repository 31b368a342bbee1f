"""Fixtures of fits over machines, and of photometric stereo."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from machines import Machines, values_alone

from rimlight.inverse.photometric_stereo import dataset
from rimlight.inverse.photometric_stereo.dataset import Dataset


@pytest.fixture(scope="session")
def alone(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """What `machines.posed` leads to without workers."""
    return values_alone(tmp_path_factory.mktemp("alone"))


@pytest.fixture
def machines(tmp_path: Path) -> Iterator[Machines]:
    made = Machines(tmp_path)
    yield made
    made.close()


@pytest.fixture(scope="session")
def diligent(shared: Callable[[str], Path]) -> Callable[[str], Dataset]:
    found: dict[str, Dataset] = {}

    def read(name: str) -> Dataset:
        if name not in found:
            found[name] = dataset.read(shared(f"diligent/{name}PNG"))
        return found[name]

    return read
