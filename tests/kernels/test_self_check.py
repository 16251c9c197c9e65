# SPDX-License-Identifier: Apache-2.0
"""A back-end that draws otherwise than the processor is found before it is used."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from structgstream.kernels.backend import cpu_backend, reference_backend
from structgstream.kernels.self_check import disagreement
from structgstream.kernels.values import RasterOutput
from tests.support.backends import needs_native

ORACLE = reference_backend().rasterize
HERE = torch.device("cpu")


@needs_native
def test_the_processors_kernels_agree_with_the_reference() -> None:
    assert disagreement(cpu_backend().rasterize, ORACLE, HERE) is None


class _Steeper(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: torch.Tensor) -> torch.Tensor:
        return value.clone()

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> torch.Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return 1.01 * gradient


def _darker(gaussians: Any, viewport: Any, **options: Any) -> RasterOutput:
    drawn = ORACLE(gaussians, viewport, **options)
    return replace(drawn, image=0.99 * drawn.image)


def _steeper(gaussians: Any, viewport: Any, **options: Any) -> RasterOutput:
    return ORACLE(replace(gaussians, scales=_Steeper.apply(gaussians.scales)), viewport, **options)


def _undefined(gaussians: Any, viewport: Any, **options: Any) -> RasterOutput:
    drawn = ORACLE(gaussians, viewport, **options)
    return replace(drawn, image=drawn.image * torch.nan)


@pytest.mark.parametrize(
    ("rasterize", "named"), [(_darker, "pictures"), (_steeper, "gradients of scales"), (_undefined, "pictures")]
)
def test_what_differs_is_named(rasterize: Callable[..., RasterOutput], named: str) -> None:
    assert str(disagreement(rasterize, ORACLE, HERE)).startswith(f"the {named} by ")
