# SPDX-License-Identifier: Apache-2.0
"""Files opened again by a reader that is not ours: gsply."""

import gzip
import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch

from structgstream.errors import ConfigError
from structgstream.exporters.bake import BakedGaussians
from structgstream.exporters.formats import FrameOptions, SpzVersion
from structgstream.exporters.web import fractional_bits, spz_bytes
from structgstream.exporters.write import write_gaussians
from tests.support.plain import RIG, picture, psnr, some


@pytest.fixture
def read_spz() -> Iterator[Callable[[Path], gsply.GSData]]:
    """With its compiled code where the wheel has it: numba takes seconds to compile the other."""
    gsply.use_backend("auto")
    yield gsply.read_spz
    gsply.use_backend("python")


@pytest.mark.parametrize(("degree", "version"), [(0, 2), (2, 2), (1, 3), (3, 3), (0, 4), (3, 4)])
def test_spz_as_gsply_reads_it(
    degree: int, version: SpzVersion, tmp_path: Path, read_spz: Callable[[Path], gsply.GSData]
) -> None:
    wanted = some(degree=degree)
    write_gaussians(tmp_path / "set.spz", wanted, format="spz", options=FrameOptions(spz_version=version))
    data = read_spz(tmp_path / "set.spz")
    sh = [torch.tensor(np.asarray(data.sh0))[:, None]]
    if degree:
        assert data.shN is not None
        sh.append(torch.tensor(np.asarray(data.shN)))
    found = BakedGaussians(
        means=torch.tensor(data.means),
        quats=torch.tensor(data.quats),
        scales=torch.tensor(data.scales).exp(),
        opacities=torch.tensor(data.opacities).sigmoid(),
        sh=torch.cat(sh, dim=1),
    )
    half_turn = torch.tensor([1.0, -1.0, -1.0])
    step = 2.0 ** -fractional_bits(wanted.means)
    torch.testing.assert_close(found.means, wanted.means * half_turn, atol=0.501 * step, rtol=0)
    torch.testing.assert_close(found.scales.log(), wanted.scales.log(), atol=0.501 / 16, rtol=0)
    torch.testing.assert_close(found.opacities, wanted.opacities, atol=0.501 / 255, rtol=1e-5)
    torch.testing.assert_close(found.sh[:, 0], wanted.sh[:, 0], atol=0.501 / (0.15 * 255), rtol=1e-5)
    torch.testing.assert_close(found.sh[:, 1:].abs(), wanted.sh[:, 1:].abs().clamp(max=1), atol=1.01 / 128, rtol=0)
    along = (found.quats * wanted.y_up().quats).sum(1).abs()
    assert along.min() > (0.995 if version == 2 else 0.999995), "versions 3 and 4 have 10 bits a component"
    # The reader leaves the axes as the file has them: a camera that is turned alike sees the same picture, with
    # directions, and so every sign of every coefficient, as they are in the file.
    camera = RIG["cam01"]
    turned = replace(camera, viewmat=camera.viewmat @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double())
    assert psnr(picture(found, turned), picture(wanted)) > 38
    colors = found.colors(camera.center.float() * half_turn)
    torch.testing.assert_close(colors, wanted.colors(camera.center.float()), atol=0.15, rtol=0)


def test_spz_header() -> None:
    """As the public description has it; positions use the bits that they have."""
    data = gzip.decompress(spz_bytes(some(10, degree=1), FrameOptions()))
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<4sIIBBBB", data)
    assert (magic, version, count, degree, flags, reserved) == (b"NGSP", 2, 10, 1, 0, 0)
    assert len(data) == 16 + 10 * (9 + 1 + 3 + 3 + 3 + 9)
    far = float(some(10).means.abs().max())
    assert far * 2**bits < 2**23
    assert fractional_bits(torch.tensor([[0.0, -3000.0, 2.0]])) == 11
    assert fractional_bits(torch.zeros(0, 3)) == fractional_bits(torch.tensor([[1e-3]])) == 20


@pytest.mark.parametrize("value", [1e7, math.inf, math.nan])
def test_spz_refuses_what_does_not_fit(value: float) -> None:
    with pytest.raises(ConfigError, match=r"export a \.ply"):
        spz_bytes(replace(some(1), means=torch.tensor([[0.0, value, 0.0]])), FrameOptions())
