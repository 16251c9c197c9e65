# SPDX-License-Identifier: Apache-2.0
"""Files opened again by a reader that is written here, from the layout."""

import math
import struct
from pathlib import Path

import pytest
import torch
from torch import Tensor

from structgstream.errors import ConfigError
from structgstream.exporters.bake import BakedGaussians
from structgstream.exporters.formats import FrameOptions
from structgstream.exporters.web import splat_bytes
from structgstream.exporters.write import write_gaussians
from structgstream.geometry import quaternion_matrices
from structgstream.harmonics import Y0
from tests.support.plain import picture, psnr, some


def read_splat(data: bytes) -> BakedGaussians:
    """From the layout: 3 float32 position, 3 float32 scale, 4 bytes rgba, 4 bytes quaternion wxyz about 128."""
    means, scales, quats, rgba = [], [], [], []
    for offset in range(0, len(data), 32):
        row = struct.unpack_from("<6f8B", data, offset)
        means.append(row[:3])
        scales.append(row[3:6])
        rgba.append([value / 255 for value in row[6:10]])
        quats.append([(value - 128) / 128 for value in row[10:14]])
    colors = torch.tensor(rgba)
    return BakedGaussians(
        means=torch.tensor(means),
        quats=torch.tensor(quats),
        scales=torch.tensor(scales),
        opacities=colors[:, 3],
        sh=((colors[:, :3] - 0.5) / Y0)[:, None],
    )


def test_splat_as_its_layout_says(tmp_path: Path) -> None:
    wanted = some()
    write_gaussians(tmp_path / "set.splat", wanted, format="splat")
    data = (tmp_path / "set.splat").read_bytes()
    assert len(data) == 32 * len(wanted)
    found = read_splat(data)
    importance = found.scales.prod(1) * wanted.opacities[rows(found.means, wanted.means)]
    assert (importance.diff() <= 1e-9).all()
    sorted_ = wanted.select(rows(found.means, wanted.means))
    assert torch.equal(found.means, sorted_.means)
    assert torch.equal(found.scales, sorted_.scales)
    torch.testing.assert_close(found.opacities, sorted_.opacities, atol=0.501 / 255, rtol=0)
    colors = (0.5 + Y0 * sorted_.sh[:, 0]).clamp(0, 1)
    torch.testing.assert_close(0.5 + Y0 * found.sh[:, 0], colors, atol=0.501 / 255, rtol=0)
    assert angle(found.quats, sorted_.quats) < 1.0
    assert psnr(picture(found), picture(wanted)) > 45


def rows(found: Tensor, wanted: Tensor) -> Tensor:
    """For each of ``found`` the row of ``wanted`` that is nearest."""
    return torch.cdist(found, wanted).argmin(1)


def angle(one: Tensor, other: Tensor) -> float:
    """The largest angle between two rotations, degrees."""
    products = quaternion_matrices(one).mT @ quaternion_matrices(other)
    cosines = (products.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    return math.degrees(float(cosines.clamp(-1, 1).acos().max()))


def test_splat_holds_one_colour() -> None:
    with pytest.raises(ConfigError, match="degree 1"):
        splat_bytes(some(degree=1), FrameOptions())
