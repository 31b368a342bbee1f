"""PyTorch on both sides of the renderer: a module as the loss of a fit, and the renderer as a layer of a network."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from rimlight.loading import InputError

from . import sources
from .free_parameters import check_key, to_numpy
from .losses import Loss, LossFunction, value_and_metrics
from .problem import Free, Problem, Stage, Target
from .renderer import Renderer, Task, alone
from .view import derived_seed

#: Scenes whose kernels `torch_render` remembers.
REMEMBERED = 4

#: Ends of the names of parameters that Mitsuba keeps flat -> numbers in a row.
ROWS = {"positions": 3, "normals": 3, "texcoords": 2}


def _torch() -> Any:
    try:
        import torch
    except ImportError:
        raise InputError("fit: this needs PyTorch: pip install 'rimlight[torch]'") from None
    return torch


def torch_loss(module: Callable[..., Any], label: str = "") -> LossFunction:
    """A loss from PyTorch, which is differentiated automatically.

    module : an `nn.Module`, or a function, of image and target, both (1, C, H, W), linear radiance; float32 on the CPU,
        or as the first parameter of the module is. It returns a tensor of one number; or such a tensor and metrics,
        label -> number. Where a pixel does not count, it sees the target in both.
    label : what it measures, for the report.

    Raises
    ------
    InputError : PyTorch is missing, or the module is none. A step of the fit raises it if no number is returned, or one
        that does not depend on the image.
    """
    torch = _torch()
    if isinstance(module, type) or not callable(module):
        raise InputError(f"fit: torch_loss takes a module or a function of image and target, got {module!r}")

    def loss(image: np.ndarray, target: np.ndarray, weight: np.ndarray) -> tuple[float, np.ndarray, dict[str, float]]:
        with torch.inference_mode(False), torch.enable_grad():
            of_module = module.parameters() if isinstance(module, torch.nn.Module) else ()
            like = next(iter(of_module), torch.zeros(()))
            seen = torch.tensor(np.asarray(image, np.float32), requires_grad=True)
            wanted = torch.tensor(np.asarray(target, np.float32)).expand_as(seen)
            share = torch.tensor(np.asarray(weight, np.float32))[..., None].clamp(0, 1)
            as_batch = lambda picture: picture.permute(2, 0, 1)[None].to(like.device, like.dtype)
            value, metrics = value_and_metrics(module(as_batch(wanted + share * (seen - wanted)), as_batch(wanted)))
            gradient = None
            if torch.is_tensor(value) and value.numel() == 1 and value.requires_grad:
                (gradient,) = torch.autograd.grad(value, seen, allow_unused=True)
            if gradient is None:
                got = f"{value.numel()} of Tensor" if torch.is_tensor(value) else type(value).__name__
                raise InputError(f"a loss must return one number of PyTorch that depends on the image, got {got}")
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
    channel: str | None = None,
) -> Any:
    """Render a scene as a layer of PyTorch.

    Backward, the scene is rendered again, with random numbers of its own: the gradient is unbiased for losses that are
    linear or quadratic in the image. Only the tensors that need a gradient get one.

    Parameters
    ----------
    scene : `mi.Scene`, or path of a scene file, which is read once. It is left with these parameters.
    params : key of `mi.traverse(scene)` -> tensor: flat, or in the shape of the parameter; points: also (N, 3);
        transformations: (4, 4). A parameter that is left out has the value that it had before it was first given.
    sensor : number of the sensor. spp : samples per pixel. seed : random seed; change it from step to step.
    integrator : name of the plugin, or its name as "type" with its parameters.
    channel : what of `aov_edge` is returned, such as a depth map or a mask. Default: none, for all others.

    Returns
    -------
    image : tensor, (H, W, C), float32, linear radiance, on the CPU.

    Raises
    ------
    InputError : PyTorch is missing, the scene has no such parameter, it is of another size, or has no derivative.
    """
    torch = _torch()
    if not isinstance(params, Mapping) or not isinstance(integrator, Mapping | str):
        raise InputError(
            "torch_render: params is a dictionary of tensors, and integrator a name or a dictionary, got "
            f"{type(params).__name__} and {type(integrator).__name__}"
        )
    options = {"type": integrator} if isinstance(integrator, str) else dict(integrator)
    task = Task(_whole("sensor", sensor, 0), None, _whole("spp", spp, 1), _whole("seed", seed, 0))
    variant = mi.variant() or Problem.variant
    with alone(variant):
        renderer = _renderer(_scene(scene, variant), variant, tuple(sorted(options.items())), channel)
        if task.target >= len(renderer.views):
            raise InputError(f"torch_render: the scene has {len(renderer.views)} sensors, there is no number {sensor}")
        known = _originals(renderer.views[0].scene)
        for key in params:
            check_key(key, renderer.params, "torch_render")
            known.setdefault(key, to_numpy(renderer.views[0].loaded.params[key]))
    tensors = [_fitting(torch, key, value, known[key].shape) for key, value in params.items()]
    return _layer(torch).apply(renderer, task, known, tuple(params), *tensors)


def _whole(name: str, value: Any, least: int) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        number = -1
    if not least <= number < 2**32:
        raise InputError(f"torch_render: {name} must be a whole number >= {least} and < 2³², got {value!r}")
    return number


def _fitting(torch: Any, key: str, value: Any, shape: tuple[int, ...]) -> Any:
    """The tensor of a parameter. InputError : it cannot be one of this shape."""
    try:
        tensor = torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f'torch_render: "{key}" must be a tensor, got {type(value).__name__}') from None
    if tensor.is_complex():
        raise InputError(f'torch_render: "{key}" must be real, got {tensor.dtype}')
    size = int(np.prod(shape))
    if tensor.numel() != size:
        raise InputError(f'torch_render: "{key}" has {size} numbers, got {tensor.numel()}')
    row = ROWS.get(key.rpartition("_")[2]) if len(shape) == 1 else None
    shape = shape if row is None else (size // row, row)
    if tensor.ndim > 1 < len(shape) and tuple(tensor.shape) != shape:
        raise InputError(f'torch_render: "{key}" is of the shape {shape}, or flat, got {tuple(tensor.shape)}')
    return tensor


@lru_cache(maxsize=REMEMBERED)
def _of_file(path: str, variant: str) -> mi.Scene:
    return sources.scene(Path(path), {})


def _scene(source: Any, variant: str) -> mi.Scene:
    """InputError : it is none."""
    if isinstance(source, str | Path):
        return _of_file(str(source), variant)
    if not isinstance(source, mi.Scene):
        raise InputError(
            f"torch_render: a scene is an mi.Scene or the path of a file, got {type(source).__name__}; load a "
            "dictionary once, by mi.load_dict"
        )
    return source


@lru_cache(maxsize=REMEMBERED)
def _originals(scene: mi.Scene) -> dict[str, np.ndarray]:
    """Parameters that have been given: key -> the value before, as `to_numpy` makes it."""
    return {}


@lru_cache(maxsize=REMEMBERED)
def _renderer(scene: mi.Scene, variant: str, options: tuple[tuple[str, Any], ...], channel: str | None) -> Renderer:
    """What renders a scene from all of its sensors. The targets are not used."""
    nothing = lambda view: np.zeros((*view.size, 3), np.float32)
    targets = tuple(Target(file=nothing, sensor=i) for i in range(len(scene.sensors())))
    free = Free(key="any", kind="material")
    loss, chosen = Loss(channel=channel), dict(options)
    return Renderer(
        Problem(scene=scene, target=targets, free=free, loss=loss, integrator=chosen, stage=Stage(), variant=variant)
    )


@lru_cache
def _layer(torch: Any) -> Any:
    class Layer(torch.autograd.Function):
        """Image of parameters: one view of a `Renderer`."""

        @staticmethod
        def forward(
            ctx: Any,
            renderer: Renderer,
            task: Task,
            known: Mapping[str, np.ndarray],
            keys: tuple[str, ...],
            *tensors: Any,
        ) -> Any:
            ctx.renderer, ctx.task, ctx.known, ctx.keys = renderer, task, known, keys
            ctx.save_for_backward(*tensors)
            with alone(renderer.problem.variant):
                image = renderer.image({**known, **_values(keys, tensors)}, task)
            return torch.from_numpy(np.ascontiguousarray(image))

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, by_image: Any) -> Any:
            tensors, needs = ctx.saved_tensors, ctx.needs_input_grad[-len(ctx.keys) :]
            task = Task(ctx.task.target, None, ctx.task.spp, derived_seed(ctx.task.seed))
            wanted = [key for key, needs in zip(ctx.keys, needs, strict=True) if needs]
            values = {**ctx.known, **_values(ctx.keys, tensors)}  # of others, also if they were given since
            with alone(ctx.renderer.problem.variant):
                found = ctx.renderer.gradient_of(values, by_image.detach().cpu().numpy(), task, wanted)
            gradients = (
                torch.from_numpy(np.ascontiguousarray(found[key])).reshape(tensor.shape).to(tensor)
                if key in found
                else None
                for key, tensor in zip(ctx.keys, tensors, strict=True)
            )
            return None, None, None, None, *gradients

    return Layer


def _values(keys: tuple[str, ...], tensors: tuple[Any, ...]) -> dict[str, np.ndarray]:
    return {key: t.detach().float().cpu().numpy() for key, t in zip(keys, tensors, strict=True)}
