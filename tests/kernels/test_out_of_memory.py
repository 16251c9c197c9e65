# SPDX-License-Identifier: Apache-2.0
"""What a kernel says when it gets no memory becomes an error of the package that still is a ``MemoryError``."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from structgstream.codec.entropy import decisions, rans
from structgstream.codec.entropy.decisions import ArithmeticState
from structgstream.errors import OutOfMemoryError
from structgstream.kernels import cpu_anchors, cpu_motion, cpu_raster
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.native import native_reason
from structgstream.kernels.values import Anchors, Neighbors, ViewFlows
from tests.support.splats import splats_of, viewport_of

pytestmark = pytest.mark.skipif(native_reason() is not None, reason="the native library is not built here")
Z = torch.zeros
SPLATS = splats_of(Z(1, 3), Z(1, 4), Z(1, 3), Z(1), Z(1, 3))
VIEW = viewport_of(torch.eye(4), torch.eye(3), width=8, height=8, near=0.1)


def backward() -> None:
    """Forward has memory, backward has none."""
    means = Z(1, 3, requires_grad=True)
    drawn = cpu_raster.rasterize(replace(SPLATS, means=means), VIEW)
    short = SimpleNamespace(sgs_raster_backward=lambda *_: 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cpu_raster, "native_library", lambda: short)
        drawn.image.sum().backward()


def tables() -> rans.FrequencyTables:
    return rans.FrequencyTables(np.array([[2048, 2048]], np.uint16))


CALLS: dict[str, tuple[object, str, int | None, Callable[[], object]]] = {
    "raster": (
        cpu_raster,
        "sgs_raster_forward",
        None,
        lambda: cpu_raster.rasterize(SPLATS, VIEW),
    ),
    "radii": (
        cpu_raster,
        "sgs_raster_radii",
        1,
        lambda: cpu_raster.projected_radii(SPLATS, VIEW),
    ),
    "weights": (
        cpu_raster,
        "sgs_raster_weights",
        1,
        lambda: cpu_raster.blending_weights(SPLATS, VIEW, Z(8, 8, 1)),
    ),
    "planes": (
        cpu_motion,
        "sgs_plane_scores",
        1,
        lambda: cpu_motion.plane_scores(Z(8, 8), [Z(8, 8)], Z(1, 1, 3, 3), window=3, noise=0.1),
    ),
    "residual": (
        cpu_motion,
        "sgs_picture_residual",
        1,
        lambda: cpu_motion.picture_residuals(Z(1, 8, 8, 3), Z(1, 8, 8, 3).byte()),
    ),
    "lift": (
        cpu_motion,
        "sgs_lift_flow",
        1,
        lambda: cpu_motion.lift(
            Z(1, 3),
            ViewFlows(Z(1, 1), Z(1, 1, 2), Z(1, 4, 4), Z(1, 3, 3), Z(1)),
            Neighbors(Z(1, 1).long(), Z(1, 1)),
            Z(1, 3),
            share=0.5,
        ),
    ),
    "change": (
        cpu_motion,
        "sgs_changed_pixels",
        1,
        lambda: cpu_motion.changed_pixels(Z(8, 8, 3).byte(), Z(8, 8, 3).byte(), threshold=0.1, reach_pixels=1),
    ),
    "anchors": (
        cpu_anchors,
        "sgs_anchors_visible",
        -1,
        lambda: cpu_anchors.visible_anchors(Anchors(Z(1, 3), Z(1, 3), Z(1, 3), Z(1, 2, 3), Z(1, 2)), VIEW, None),
    ),
    "encode": (
        rans,
        "sgs_rans_encode",
        1,
        lambda: rans._native_encode(np.zeros(2, np.uint8), np.zeros(2, np.uint16), tables(), lanes=1),
    ),
    "decisions": (
        rans,
        "sgs_code_numbers",
        1,
        lambda: decisions._code_native("sgs_code_numbers", ArithmeticState(None), [], 0),
    ),
    "decode": (
        rans,
        "sgs_rans_decode",
        1,
        lambda: rans._native_decode(np.zeros(2, np.uint16), np.zeros(1, np.uint32), np.zeros(2, np.uint16), tables()),
    ),
}


@pytest.mark.parametrize("name", CALLS)
def test_no_memory(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module, function, result, call = CALLS[name]
    monkeypatch.setattr(module, "native_library", lambda: SimpleNamespace(**{function: lambda *_: result}))
    with pytest.raises(OutOfMemoryError, match="^Not enough memory"):
        call()


def test_no_memory_on_the_gpu(pretended_gpu: KernelLibrary) -> None:
    with pytest.raises(OutOfMemoryError, match="on the GPU; .*--device cpu"):
        pretended_gpu.check(2)


def test_no_memory_for_gradients() -> None:
    with pytest.raises(OutOfMemoryError, match="gradients"):
        backward()
