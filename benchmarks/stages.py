# SPDX-License-Identifier: Apache-2.0
"""Where an iteration's time goes: a back-end whose operations are timed, forward and backward.

Each operation's inputs and outputs pass an identity. The backward of the outputs' identity runs before anything of the
operation's own backward, the backward of the inputs' after all of it, so the time between is the operation's, whoever
implements it. Nothing else of an iteration's graph is ready to run in between.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend


class _Mark(torch.autograd.Function):
    """The identity; its backward calls ``noted``."""

    @staticmethod
    def forward(ctx: Any, noted: Callable[[], None], *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.noted = noted
        ctx.set_materialize_grads(False)
        return tuple(tensor.view_as(tensor) for tensor in tensors)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        ctx.noted()
        return None, *gradients


def mapped(value: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """``value`` with ``change`` of its tensors: nested tuples, lists, dictionaries and dataclasses are looked into."""
    if isinstance(value, Tensor):
        return change(value)
    if isinstance(value, Mapping):
        return {key: mapped(part, change) for key, part in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(mapped(part, change) for part in value))
    if isinstance(value, list | tuple):
        return type(value)(mapped(part, change) for part in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: mapped(getattr(value, f.name), change) for f in fields(value) if f.init})
    return value


def _marked(value: Any, noted: Callable[[], None]) -> Any:
    """``value`` with its tensors that carry gradients passed through one mark."""
    carrying: list[Tensor] = []

    def found(tensor: Tensor) -> Tensor:
        if tensor.requires_grad:
            carrying.append(tensor)
        return tensor

    mapped(value, found)
    if not carrying:
        return value
    marked = iter(_Mark.apply(noted, *carrying))  # type: ignore[call-overload]
    return mapped(value, lambda tensor: next(marked) if tensor.requires_grad else tensor)


def staged(backend: Backend, seconds: dict[str, float]) -> Backend:
    """``backend`` with every operation adding the seconds of its forward and backward to ``seconds[name]``."""

    def timed(name: str, operation: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **kwargs: Any) -> Any:
            started: list[float] = []

            def leave_backward() -> None:
                if started:
                    seconds[name] += time.perf_counter() - started.pop()

            inputs = _marked((args, kwargs), leave_backward) if torch.is_grad_enabled() else (args, kwargs)
            begun = time.perf_counter()
            outputs = operation(*inputs[0], **inputs[1])
            seconds[name] += time.perf_counter() - begun
            return _marked(outputs, lambda: started.append(time.perf_counter()))

        seconds.setdefault(name, 0.0)
        return run

    return backend.with_functions(**{name: timed(name, run) for name, run in backend.functions.items()})
