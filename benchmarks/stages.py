# SPDX-License-Identifier: Apache-2.0
"""Where an iteration's time goes: a back-end whose operations are timed, forward and backward.

Each operation's inputs and outputs pass an identity. The backward of the outputs' identity runs before anything of the
operation's own backward, the backward of the inputs' after all of it, so the time between is the operation's, whoever
implements it. Nothing else of an iteration's graph is ready to run in between.
"""

import time
from collections.abc import Callable, Mapping, Sequence
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


def _tensors_of(value: Any) -> list[Tensor]:
    """The tensors in ``value`` that carry gradients: nested tuples, dictionaries and dataclasses are looked into."""
    if isinstance(value, Tensor):
        return [value] if value.requires_grad else []
    return [tensor for part in _parts(value) for tensor in _tensors_of(part)]


def _parts(value: Any) -> list[Any]:
    if isinstance(value, Mapping):
        return list(value.values())
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return list(value)
    if is_dataclass(value) and not isinstance(value, type):
        return [getattr(value, field.name) for field in fields(value)]
    return []


def _with_tensors(value: Any, marked: list[Tensor]) -> Any:
    """``value`` with its gradient-carrying tensors taken from the front of ``marked``."""
    if isinstance(value, Tensor):
        return marked.pop(0) if value.requires_grad else value
    if isinstance(value, Mapping):
        return {key: _with_tensors(part, marked) for key, part in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(_with_tensors(part, marked) for part in value))
    if isinstance(value, list | tuple):
        return type(value)(_with_tensors(part, marked) for part in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: _with_tensors(getattr(value, f.name), marked) for f in fields(value)})
    return value


def _marked(value: Any, noted: Callable[[], None]) -> Any:
    tensors = _tensors_of(value)
    return _with_tensors(value, list(_Mark.apply(noted, *tensors))) if tensors else value  # type: ignore[call-overload]


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
