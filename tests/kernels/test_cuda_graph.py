# SPDX-License-Identifier: Apache-2.0
"""Recording and replaying, with a pretended graph that runs its body on the processor, and with a real one."""

import logging
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels import cuda_graph


def pretended(body: Callable[[], Any]) -> tuple[Callable[[], None], Any]:
    """As a graph does: the memory of the recorded outputs gets the new values."""
    body()
    outputs = body()

    def replay() -> None:
        for old, new in zip(outputs, body(), strict=True):
            old.copy_(new)

    return replay, outputs


def counting(total: Tensor) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """A function that also keeps a running sum."""

    def function(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        total.add_(a.sum())
        return a * b, total.clone()

    return function


RECORDERS = [
    ("cpu", pretended),
    pytest.param("cuda", cuda_graph.record_on_gpu, marks=pytest.mark.needs_cuda),
]


@pytest.mark.parametrize(("device", "record"), RECORDERS)
def test_new_inputs_reach_the_recorded_memory(device: str, record: cuda_graph.Recorder) -> None:
    total = torch.tensor(5.0, device=device)
    example = (torch.full((3,), 7.0, device=device), torch.zeros(3, device=device))
    function = cuda_graph.captured(counting(total), example, state=[total], record=record)
    assert isinstance(function, cuda_graph.Captured)
    assert total.item() == 5.0  # recording left no trace
    assert torch.equal(example[1], torch.zeros(3, device=device))
    places = [output.data_ptr() for output in function.outputs]
    for n, expected in ((2.0, 11.0), (3.0, 20.0)):
        a, b = torch.full((3,), n, device=device), torch.arange(3.0, device=device)
        product, running = function(a, b)
        assert torch.equal(product, a * b)
        assert running.item() == total.item() == expected
        assert [product.data_ptr(), running.data_ptr()] == places


def test_other_shapes_are_refused() -> None:
    function = cuda_graph.captured(counting(torch.zeros(())), (torch.ones(3), torch.ones(3)), record=pretended)
    with pytest.raises(BackendError, match="record another"):
        function(torch.ones(4), torch.ones(3))
    with pytest.raises(BackendError, match="float64"):
        function(torch.ones(3), torch.ones(3).double())
    with pytest.raises(BackendError):
        function(torch.ones(3))


def test_without_a_gpu_it_runs_step_by_step_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    function = counting(torch.zeros(()))
    with caplog.at_level(logging.WARNING):
        assert cuda_graph.captured(function, (torch.ones(3), torch.ones(3))) is function
    assert "step by step" in caplog.text
