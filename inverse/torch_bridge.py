"""PyTorch on both sides of the renderer: a module as the loss of a fit, and the renderer as a layer of a network."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import mitsuba as mi
import numpy as np

from rimlight.loading import InputError

from .losses import LossFunction, value_and_metrics
from .problem import Free, Problem, Stage, Target
from .renderer import Renderer, Task, alone
from .view import derived_seed

#: Scenes whose kernels `torch_render` remembers.
REMEMBERED = 4


def _torch() -> Any:
    try:
        import torch
    except ImportError:
        raise InputError("fit: this needs PyTorch: pip install 'rimlight[torch]'") from None
    return torch


def torch_loss(module: Callable[..., Any], label: str = "") -> LossFunction:
    """A loss from PyTorch, which is differentiated automatically.

    module : an `nn.Module`, or a function, of image and target, both (1, C, H, W), float32, linear radiance. It returns
        a tensor of one number; or such a tensor and metrics, label -> number. Where a pixel does not count, it sees the
        target in both.
    label : what it measures, for the report.

    Raises
    ------
    InputError : PyTorch is missing.
    """
    torch = _torch()

    def loss(image: np.ndarray, target: np.ndarray, weight: np.ndarray) -> tuple[float, np.ndarray, dict[str, float]]:
        seen = torch.tensor(np.asarray(image, np.float32), requires_grad=True)
        wanted = torch.tensor(np.asarray(target, np.float32)).expand_as(seen)
        share = torch.tensor(np.asarray(weight, np.float32))[..., None].clamp(0, 1)
        as_batch = lambda picture: picture.permute(2, 0, 1)[None]
        value, metrics = value_and_metrics(module(as_batch(wanted + share * (seen - wanted)), as_batch(wanted)))
        (gradient,) = torch.autograd.grad(value, seen)
        return float(value.detach()), gradient.numpy(), metrics

    loss.label = label or getattr(module, "__name__", type(module).__name__)
    return loss


def torch_render(
    scene: Any,
    params: Mapping[str, Any],
    *,
    sensor: int = 0,
    spp: int = 16,
    seed: int = 0,
    integrator: Mapping[str, Any] | str = "prb_edge",
) -> Any:
    """Render a scene as a layer of PyTorch.

    Backward, the scene is rendered again, with random numbers of its own: the gradient is unbiased for losses that are
    linear or quadratic in the image.

    Parameters
    ----------
    scene : `mi.Scene`, or path of a scene file. It is left with these parameters.
    params : key of `mi.traverse(scene)` -> tensor with as many numbers as the parameter has; transformations: (4, 4).
    sensor : number of the sensor. spp : samples per pixel. seed : random seed; change it from step to step.
    integrator : name of the plugin, or its name as "type" with its parameters.

    Returns
    -------
    image : tensor, (H, W, C), float32, linear radiance, on the CPU.

    Raises
    ------
    InputError : PyTorch is missing, the scene has no such parameter, or it is of another size.
    """
    torch = _torch()
    options = {"type": integrator} if isinstance(integrator, str) else dict(integrator)
    source = str(scene) if not isinstance(scene, mi.Scene) else scene
    variant = mi.variant() or Problem.variant
    with alone(variant):
        renderer = _renderer(source, variant, sensor, tuple(sorted(options.items())))
    for key, value in params.items():
        if key not in renderer.params:
            raise InputError(f'torch_render: the scene has no parameter "{key}"')
        size = renderer.views[0].count(key)
        if value.numel() != size:
            raise InputError(f'torch_render: "{key}" has {size} numbers, got {value.numel()}')
    return _layer(torch).apply(renderer, Task(0, None, spp, seed), tuple(params), *params.values())


@lru_cache(maxsize=REMEMBERED)
def _renderer(scene: Any, variant: str, sensor: int, options: tuple[tuple[str, Any], ...]) -> Renderer:
    """What renders a scene. The target is not used."""
    target = Target(file=lambda view: np.zeros((*view.size, 3), np.float32), sensor=sensor)
    free = Free(key="any", kind="material")
    return Renderer(
        Problem(scene=scene, target=target, free=free, stage=Stage(), integrator=dict(options), variant=variant)
    )


@lru_cache
def _layer(torch: Any) -> Any:
    class Layer(torch.autograd.Function):
        """Image of parameters: one view of a `Renderer`."""

        @staticmethod
        def forward(ctx: Any, renderer: Renderer, task: Task, keys: tuple[str, ...], *tensors: Any) -> Any:
            ctx.renderer, ctx.task, ctx.keys = renderer, task, keys
            ctx.save_for_backward(*tensors)
            with alone(renderer.problem.variant):
                image = renderer.image(_values(keys, tensors), task)
            return torch.from_numpy(np.ascontiguousarray(image))

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, by_image: Any) -> Any:
            tensors = ctx.saved_tensors
            task = Task(0, None, ctx.task.spp, derived_seed(ctx.task.seed))
            weight = by_image.detach().cpu().numpy()
            with alone(ctx.renderer.problem.variant):
                found = ctx.renderer.gradient_of(_values(ctx.keys, tensors), weight, task)
            gradients = (
                torch.from_numpy(np.ascontiguousarray(found[key])).reshape(tensor.shape).to(tensor)
                for key, tensor in zip(ctx.keys, tensors, strict=True)
            )
            return None, None, None, *gradients

    return Layer


def _values(keys: tuple[str, ...], tensors: tuple[Any, ...]) -> dict[str, np.ndarray]:
    return {key: t.detach().cpu().numpy().astype(np.float32) for key, t in zip(keys, tensors, strict=True)}
