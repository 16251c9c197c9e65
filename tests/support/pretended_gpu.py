# SPDX-License-Identifier: Apache-2.0
"""A device that is not the processor, pretended in torch: a run shows without a GPU whether tensors of two devices
meet, and whether one that lies elsewhere is read as if it lay here.

Its tensors are wrappers that say that they lie on ``DEVICE``. Every operation on them runs on the processor, after a
check that its tensors lie together, as on a GPU: only numbers ``[]`` and indices may lie on the processor.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from benchmarks.stages import mapped

# Autograd has no threads for a GPU that is not there; for this device it works on the calling one.
DEVICE = torch.device("meta")
_INDEX_TYPES = (torch.int64, torch.int32, torch.bool)
Value = TypeVar("Value")


class _Elsewhere(Tensor):
    """A tensor that says it lies on ``DEVICE``; its values lie on the processor, in ``values_here``."""

    values_here: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, values: Tensor) -> "_Elsewhere":
        made = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls,
            values.size(),
            strides=values.stride(),
            storage_offset=values.storage_offset(),
            dtype=values.dtype,
            device=DEVICE,
        )
        made.values_here = values
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})

    # What torch makes without an operation that could be caught:

    def __getitem__(self, index: Any) -> Tensor:
        return super().__getitem__(_with_index_tensors(index))

    def __setitem__(self, index: Any, value: Any) -> None:
        super().__setitem__(_with_index_tensors(index), value)

    def new_tensor(self, data: Any, **options: Any) -> Tensor:  # type: ignore[override]
        return _Elsewhere(self.values_here.new_tensor(data, **options))

    def tolist(self) -> Any:
        return self.detach().cpu().tolist()

    def numpy(self, *, force: bool = False) -> Any:
        if not force:
            raise TypeError("a tensor on another device has no numpy array; copy it first")
        return self.detach().cpu().numpy(force=True)

    def data_ptr(self) -> int:
        raise RuntimeError("a kernel of the processor was given a tensor on another device")


def _with_index_tensors(index: Any) -> Any:
    parts = index if isinstance(index, tuple) else (index,)
    parts = tuple(torch.tensor(part) if isinstance(part, list) else part for part in parts)
    return parts if isinstance(index, tuple) else parts[0]


def _check_together(name: str, args: Any, tensors: list[Tensor]) -> None:
    here = [t for t in tensors if not isinstance(t, _Elsewhere) and t.dim() > 0]
    if name.startswith(("aten::index", "aten::_index_put")) and isinstance(args[0], _Elsewhere):
        here = [t for t in here if t.dtype not in _INDEX_TYPES]
    if here:
        raise RuntimeError(f"{name} was given tensors on two devices: {[(t.device.type, t.shape) for t in tensors]}")


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    name, target = func._schema.name, kwargs.get("device")
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    there = {id(t.values_here): t for t in tensors if isinstance(t, _Elsewhere)}
    if there and name not in ("aten::_to_copy", "aten::copy_"):
        _check_together(name, args, tensors)
    found_there = bool(there)
    if target is not None:
        found_there = torch.device(target) == DEVICE
        kwargs = {**kwargs, "device": torch.device("cpu")}
    elif name in ("aten::_to_copy", "aten::copy_"):
        found_there = isinstance(args[0], _Elsewhere)
    found = func(*tree_map(_here, args), **tree_map(_here, kwargs))
    if not found_there:
        return found
    # An operation in place gives back the tensor that it was given.
    return tree_map(lambda t: there[id(t)] if id(t) in there else _Elsewhere(t) if isinstance(t, Tensor) else t, found)


def _here(value: Any) -> Any:
    return value.values_here if isinstance(value, _Elsewhere) else value


class _PretendedDevice(TorchDispatchMode):
    def __init__(self, see: Callable[[Any, Any, Any, Any], None] | None) -> None:
        super().__init__()
        self._see = see

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = _run(func, args, kwargs or {})
        if self._see is not None:
            self._see(func, args, kwargs or {}, found)
        return found


def lies_there(value: Any) -> bool:
    """Whether this is a tensor on ``DEVICE``."""
    return isinstance(value, _Elsewhere)


def values_of(value: Any) -> Any:
    """What a kernel of the device reads and writes: the memory of a tensor there; any other value as it is."""
    return _here(value)


@contextmanager
def pretended_device(see: Callable[[Any, Any, Any, Any], None] | None = None) -> Iterator[None]:
    """``DEVICE`` holds tensors within, in this thread and in those that begin within.

    Args:
        see: gets every operation: the function, its arguments, its options and its result.
    """
    run, tensor = threading.Thread.run, torch.tensor

    def run_on_device(self: threading.Thread) -> None:
        with _PretendedDevice(see):
            run(self)

    def tensor_on_device(data: Any, *, device: Any = None, **options: Any) -> Tensor:
        made = tensor(data, **options)
        return made if device is None else made.to(device)

    threading.Thread.run, torch.tensor = run_on_device, tensor_on_device  # type: ignore[method-assign, assignment]
    try:
        with _PretendedDevice(see):
            yield
    finally:
        threading.Thread.run, torch.tensor = run, tensor  # type: ignore[method-assign, assignment]


def moved(value: Value, device: torch.device) -> Value:
    """``value`` with its tensors on ``device``, as :func:`benchmarks.stages.mapped` finds them."""
    return mapped(value, lambda tensor: tensor.to(device))
