# SPDX-License-Identifier: Apache-2.0
"""A stream is made, and read, with tensors on another device than the processor: no two devices meet."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import structgstream
from structgstream.kernels import cpu_raster, reference_raster
from structgstream.kernels.native import native_reason
from structgstream.session.presets import PRESETS
from tests.support.pretended_gpu import DEVICE, pretended_device, pretended_gpu
from tests.support.small_clip import small_clip_path
from tests.support.small_presets import FEW_POINTS

FRAMES, SCALE = 2, 0.25
DRAWN_BY = cpu_raster.rasterize if native_reason() is None else reference_raster.rasterize


@pytest.fixture
def backend() -> Iterator[structgstream.Backend]:
    """Drawing is the processor's."""
    with pretended_device():
        yield pretended_gpu(DRAWN_BY)


@pytest.mark.parametrize("preset", ["compact", "paper-n3dv"])
def test_a_stream_on_another_device(preset: str, backend: structgstream.Backend, tmp_path: Path) -> None:
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
    reports = structgstream.reconstruct(
        small_clip_path(), path, preset=config, scale=SCALE, frames=FRAMES, backend=backend
    )
    assert [report.moving > 0 for report in reports] == [False, True]
    found = structgstream.evaluate(path, small_clip_path(), metrics="basic", backend=backend)
    assert 10.0 < found.mean.psnr < 40.0


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
