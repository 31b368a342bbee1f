"""A log of a fit for TensorBoard."""

from __future__ import annotations

from pathlib import Path

from rimlight.edge_sampling.refusals import InputError

from .progress import Step


class TensorBoard:
    """Writes loss, errors and metrics of each step into a folder. InputError : the package tensorboardX is missing."""

    def __init__(self, folder: Path):
        try:
            from tensorboardX import SummaryWriter
        except ImportError:
            raise InputError(
                "fit: a log for TensorBoard needs the package tensorboardX: pip install tensorboardX"
            ) from None
        self._writer = SummaryWriter(str(folder))

    def __call__(self, step: Step) -> None:
        for label, number in {"loss": step.loss, **step.errors, **step.metrics}.items():
            self._writer.add_scalar(label, number, step.number)

    def close(self) -> None:
        self._writer.close()
