# SPDX-License-Identifier: Apache-2.0
"""Timing an operation must not change what it gives, and must see its forward and its backward."""

from typing import Any

import pytest
import torch
from torch import Tensor

from benchmarks.stages import staged
from benchmarks.world import HELD_OUT, wall_rig, wall_scene
from structgstream.kernels.backend import reference_backend
from structgstream.scene.render import draw


def gradients(backend) -> list[Tensor]:
    scene, rig = wall_scene(30, cameras=2), wall_rig(2, width=32, height=24)
    anchors = scene.anchors
    leaves = [anchors.positions.requires_grad_(), scene.mlps.covariance.w1.requires_grad_()]
    image = draw(scene.gaussians(rig[HELD_OUT], backend), rig[HELD_OUT], backend).image
    l1, ssim = backend.l1_ssim(image, torch.zeros(24, 32, 3, dtype=torch.uint8))
    return [image.detach(), *torch.autograd.grad(l1 - ssim, leaves)]


def test_the_results_are_the_same_bits_and_every_operation_is_seen() -> None:
    seconds: dict[str, float] = {}
    plain, timed = gradients(reference_backend()), gradients(staged(reference_backend(), seconds))
    assert all(torch.equal(a, b) for a, b in zip(plain, timed, strict=True))
    assert all(seconds[name] > 0 for name in ("rasterize", "l1_ssim", "generate_structured"))
    assert seconds["adam_step"] == 0.0


class _Costs(torch.autograd.Function):
    """The identity; forward takes 2 seconds of ``clock``, backward 5."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, clock: list[float]) -> Tensor:
        ctx.clock = clock
        clock[0] += 2.0
        return x.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        ctx.clock[0] += 5.0
        return gradients[0], None


def test_an_operation_is_reported_its_own_forward_and_backward(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr("benchmarks.stages.time.perf_counter", lambda: clock[0])

    def costly(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        return _Costs.apply(_Costs.apply(image, clock), clock), target  # type: ignore[return-value]

    seconds: dict[str, float] = {}
    backend = staged(reference_backend().with_functions(l1_ssim=costly), seconds)
    before = _Costs.apply(torch.zeros(2, 2, requires_grad=True), clock)
    inside, _ = backend.l1_ssim(before, torch.zeros(2, 2))
    after: Any = _Costs.apply(inside, clock)
    after.sum().backward()
    assert clock == [28.0]
    assert seconds["l1_ssim"] == 14.0  # Two of the four.
