# SPDX-License-Identifier: Apache-2.0
"""A stream is made, and read, by the cuda back-end with its kernels run on the processor: no two devices meet."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import structgstream
from structgstream.kernels.backend import cpu_backend
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.self_check import disagreement
from structgstream.session.presets import PRESETS
from tests.support.backends import needs_native
from tests.support.counted_gpu import counted_gpu
from tests.support.pretended_gpu import DEVICE, pretended_device
from tests.support.small_clip import small_clip_path
from tests.support.small_presets import FEW_POINTS

FRAMES, SCALE = 2, 0.25


@needs_native
@pytest.mark.parametrize("preset", ["compact", "paper-n3dv"])
def test_a_stream_on_another_device(
    preset: str, emulation: Callable[[int], KernelLibrary], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    config = PRESETS[preset]
    growth = replace(config.initial.growth, collect_from=2, start=2, stop=6, interval=2)
    patching = replace(config.online.patching, iteration=2)
    config = replace(
        config,
        points=FEW_POINTS,
        initial=replace(config.initial, iterations=6, coarse_iterations=0, medium_iterations=0, growth=growth),
        online=replace(config.online, iterations=3, patching=patching),
    )
    path = tmp_path / "out.sgs"
    with counted_gpu(emulation(0).library, monkeypatch) as (backend, counts):
        reports = structgstream.reconstruct(
            small_clip_path(), path, preset=config, scale=SCALE, frames=FRAMES, backend=backend
        )
        assert [report.moving > 0 for report in reports] == [False, True]
        found = structgstream.evaluate(path, small_clip_path(), metrics="basic", backend=backend)
    # Frame 0 is fitted in torch, and so is the frame after it where free Gaussians are spawned by their gradients.
    assert bool(counts.operations["iterations"]) is (preset == "compact")
    assert counts.operations["sgs_cuda_raster_backward"] > 0
    assert 10.0 < found.mean.psnr < 40.0


@needs_native
def test_the_check_before_use_passes(
    emulation: Callable[[int], KernelLibrary], monkeypatch: pytest.MonkeyPatch
) -> None:
    with counted_gpu(emulation(0).library, monkeypatch) as (backend, _):
        assert disagreement(backend.rasterize, cpu_backend().rasterize, backend.device) is None


def test_two_devices_that_meet_are_found() -> None:
    with pretended_device():
        there, here = torch.ones(3, device=DEVICE), torch.ones(3)
        assert (there.device, (there + 1.0).cpu().tolist()) == (DEVICE, [2.0, 2.0, 2.0])
        with pytest.raises(RuntimeError, match="two devices"):
            torch.add(there, here)
        with pytest.raises(RuntimeError, match="two devices"):
            here[torch.tensor([0, 2], device=DEVICE)]
        with pytest.raises(TypeError, match="no numpy array"):
            there.numpy()
        with pytest.raises(RuntimeError, match="kernel of the processor"):
            there.data_ptr()
        there[torch.tensor([1])] = 5.0
        assert there.tolist() == [1.0, 5.0, 1.0]
