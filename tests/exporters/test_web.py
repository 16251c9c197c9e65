# SPDX-License-Identifier: Apache-2.0
"""Files opened again by readers that are not ours, or were written from the formats' descriptions."""

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
from torch import Tensor

from structgstream.cameras import Similarity
from structgstream.errors import ConfigError, StreamError
from structgstream.exporters.bake import BakedGaussians
from structgstream.exporters.formats import Format, FrameOptions, SpzVersion
from structgstream.exporters.web import codebook, fractional_bits, splat_bytes, spz_bytes, vector_palette
from structgstream.exporters.write import FORMAT_BYTES, write_gaussians
from structgstream.geometry import quaternion_matrices
from structgstream.harmonics import Y0
from structgstream.scene.order import morton_order
from tests.support.plain import RIG, picture, psnr, some
from tests.support.sog_reader import read_sog


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


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_sog_as_a_second_reader_reads_it(degree: int, tmp_path: Path) -> None:
    wanted = some(degree=degree)
    found = read_sog(write_gaussians(tmp_path / "set.sog", wanted, format="sog"))
    wanted = wanted.select(morton_order(wanted.means))
    assert found.degree == degree
    torch.testing.assert_close(found.means, wanted.means, atol=2e-4, rtol=1e-4)
    torch.testing.assert_close(found.scales.log(), wanted.scales.log(), atol=0.05, rtol=0)
    torch.testing.assert_close(found.opacities, wanted.opacities, atol=0.51 / 255, rtol=0)
    torch.testing.assert_close(found.sh, wanted.sh, atol=0.03, rtol=0)
    turns, wanted_turns = quaternion_matrices(found.quats), quaternion_matrices(wanted.quats)
    torch.testing.assert_close(turns, wanted_turns, atol=0.02, rtol=0)
    assert psnr(picture(found), picture(wanted)) > 38


def test_a_codebook_has_the_nearest_value_of_each() -> None:
    values = np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32)
    values[0, 0] = 40.0  # one far value does not make the others coarse
    book, indices = codebook(values)
    assert book.shape == (256,)
    assert np.array_equal(indices, np.abs(values[..., None] - book).argmin(-1))
    assert np.abs(book[indices] - values).mean() < 0.01
    assert abs(book[indices[0, 0]] - 40.0) < 0.01
    same, indices = codebook(np.full((5, 3), 2.0, np.float32))
    assert np.array_equal(same[indices], np.full((5, 3), 2.0))


def test_a_palette_has_at_most_as_many_entries_as_a_label_can_count() -> None:
    rows = np.random.default_rng(0).normal(size=(70_000, 3)).astype(np.float32)
    palette, labels = vector_palette(rows)
    assert palette.shape == (65_536, 3)
    assert np.array_equal(np.unique(labels), np.arange(65_536))
    assert np.abs(palette[labels] - rows).mean() < 0.02


@pytest.mark.parametrize("format", FORMAT_BYTES)
@pytest.mark.parametrize("scale", [1e-300, 1e300])
def test_values_that_no_file_can_hold_are_refused(format: Format, scale: float, tmp_path: Path) -> None:
    gaussians = some().in_capture_units(Similarity((0.0, 0.0, 0.0), scale))
    with pytest.raises(StreamError, match="Gaussians are infinite, zero or no numbers.*inspect shows the similarity"):
        write_gaussians(tmp_path / "set", gaussians, format=format)
    assert not [*tmp_path.iterdir()]
