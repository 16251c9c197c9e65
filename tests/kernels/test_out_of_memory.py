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
from structgstream.kernels.values import Anchors, Neighbors, ViewFlows
from tests.support.backends import needs_native
from tests.support.splats import splats_of, viewport_of

pytestmark = needs_native
Z = torch.zeros
SPLATS = splats_of(Z(1, 3), Z(1, 4), Z(1, 3), Z(1), Z(1, 3))
VIEW = viewport_of(torch.eye(4), torch.eye(3), width=8, height=8, near=0.1)


TABLES = rans.FrequencyTables(np.array([[2048, 2048]], np.uint16))
ANCHORS = Anchors(Z(1, 3), Z(1, 3), Z(1, 3), Z(1, 2, 3), Z(1, 2))
FLOWS = ViewFlows(Z(1, 1), Z(1, 1, 2), Z(1, 4, 4), Z(1, 3, 3), Z(1))
NEIGHBORS = Neighbors(Z(1, 1).long(), Z(1, 1))
BYTES, SHORTS, WORDS = np.zeros(2, np.uint8), np.zeros(2, np.uint16), np.zeros(1, np.uint32)
PICTURE = Z(8, 8, 3).byte()
CHANGE = {"threshold": 0.1, "reach_pixels": 1}

CALLS: dict[str, tuple[object, Callable[[], object]]] = {
    "sgs_raster_forward": (cpu_raster, lambda: cpu_raster.rasterize(SPLATS, VIEW)),
    "sgs_raster_radii": (cpu_raster, lambda: cpu_raster.projected_radii(SPLATS, VIEW)),
    "sgs_raster_weights": (cpu_raster, lambda: cpu_raster.blending_weights(SPLATS, VIEW, Z(8, 8, 1))),
    "sgs_plane_scores": (
        cpu_motion,
        lambda: cpu_motion.plane_scores(Z(8, 8), [Z(8, 8)], Z(1, 1, 3, 3), window=3, noise=0.1),
    ),
    "sgs_picture_residual": (cpu_motion, lambda: cpu_motion.picture_residuals(Z(1, 8, 8, 3), PICTURE[None])),
    "sgs_lift_flow": (cpu_motion, lambda: cpu_motion.lift(Z(1, 3), FLOWS, NEIGHBORS, Z(1, 3), share=0.5)),
    "sgs_changed_pixels": (cpu_motion, lambda: cpu_motion.changed_pixels(PICTURE, PICTURE, **CHANGE)),
    "sgs_anchors_visible": (cpu_anchors, lambda: cpu_anchors.visible_anchors(ANCHORS, VIEW, None)),
    "sgs_rans_encode": (rans, lambda: rans._native_encode(BYTES, SHORTS, TABLES, lanes=1)),
    "sgs_rans_decode": (rans, lambda: rans._native_decode(SHORTS, WORDS, SHORTS, TABLES)),
    "sgs_code_numbers": (
        rans,
        lambda: decisions._code_native("sgs_code_numbers", ArithmeticState(None), [], 0),
    ),
}
"""By function of the library: the module that calls it, and how."""


@pytest.mark.parametrize("function", CALLS)
def test_no_memory(function: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module, call = CALLS[function]
    result = {"sgs_raster_forward": None, "sgs_anchors_visible": -1}.get(function, 1)
    monkeypatch.setattr(module, "native_library", lambda: SimpleNamespace(**{function: lambda *_: result}))
    with pytest.raises(OutOfMemoryError, match="^Not enough memory"):
        call()


def test_no_memory_on_the_gpu(pretended_gpu: KernelLibrary) -> None:
    with pytest.raises(OutOfMemoryError, match="on the GPU; .*--device cpu"):
        pretended_gpu.check(2)


def test_no_memory_for_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forward has memory, backward has none."""
    drawn = cpu_raster.rasterize(replace(SPLATS, means=Z(1, 3, requires_grad=True)), VIEW)
    monkeypatch.setattr(cpu_raster, "native_library", lambda: SimpleNamespace(sgs_raster_backward=lambda *_: 1))
    with pytest.raises(OutOfMemoryError, match="gradients"):
        drawn.image.sum().backward()
