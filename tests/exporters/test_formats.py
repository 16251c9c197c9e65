# SPDX-License-Identifier: Apache-2.0
"""Each format, opened again by a reader that is not ours: plyfile, gsply, and one written here for .splat."""

import gzip
import math
import resource
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch
from plyfile import PlyData
from torch import Tensor

from rigs import arc_rig
from structgstream.cameras import Camera
from structgstream.errors import ConfigError, StorageError
from structgstream.exporters.baked import BakedGaussians
from structgstream.exporters.formats import FORMATS, Format
from structgstream.exporters.ply import ply_bytes
from structgstream.exporters.splat import splat_bytes
from structgstream.exporters.spz import fractional_bits, spz_bytes
from structgstream.exporters.write import write_gaussians
from structgstream.geometry import quaternion_matrices
from structgstream.kernels.backend import reference_backend
from structgstream.scene.harmonics import Y0
from structgstream.scene.render import render

RIG = arc_rig(4, width=64, height=48)


def some(count: int = 300, *, degree: int = 0) -> BakedGaussians:
    """Random Gaussians around the origin."""
    g = torch.Generator().manual_seed(3)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=1)
    sh = torch.randn(count, (degree + 1) ** 2, 3, generator=g) * 0.3
    return BakedGaussians(
        means=torch.randn(count, 3, generator=g) * 0.5,
        quats=torch.where(quats[:, :1] < 0, -quats, quats),
        scales=torch.exp(torch.randn(count, 3, generator=g) * 0.5 - 3.0),
        opacities=torch.rand(count, generator=g) * 0.9 + 0.05,
        sh=sh,
    )


def picture(gaussians: BakedGaussians, camera: Camera = RIG["cam01"]) -> Tensor:
    return render(gaussians, camera, reference_backend()).image


def psnr(one: Tensor, other: Tensor) -> float:
    return float(-10 * (one - other).square().mean().log10())


def column(vertices: np.ndarray, *names: str) -> Tensor:
    return torch.from_numpy(np.stack([np.asarray(vertices[name]) for name in names], axis=1).astype(np.float32))


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_ply_as_plyfile_reads_it(degree: int, tmp_path: Path) -> None:
    wanted = some(degree=degree)
    size = write_gaussians(tmp_path / "a" / "set.ply", wanted, format="ply")
    assert (tmp_path / "a" / "set.ply").stat().st_size == size
    (element,) = PlyData.read(str(tmp_path / "a" / "set.ply")).elements
    rest = 3 * ((degree + 1) ** 2 - 1)
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(rest))]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    assert element.name == "vertex"
    assert [entry.name for entry in element.properties] == names
    assert {entry.val_dtype for entry in element.properties} == {"f4"}
    vertices = element.data
    sh = [column(vertices, "f_dc_0", "f_dc_1", "f_dc_2")[:, None]]
    if degree:
        # All of red, then of green, then of blue.
        by_channel = column(vertices, *(f"f_rest_{i}" for i in range(rest))).reshape(len(wanted), 3, -1)
        sh.append(by_channel.transpose(1, 2))
    found = BakedGaussians(
        means=column(vertices, "x", "y", "z"),
        quats=column(vertices, "rot_0", "rot_1", "rot_2", "rot_3"),
        scales=column(vertices, "scale_0", "scale_1", "scale_2").exp(),
        opacities=column(vertices, "opacity")[:, 0].sigmoid(),
        sh=torch.cat(sh, dim=1),
    )
    for name in ("means", "quats", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name), rtol=1e-5, atol=1e-6)
    assert not column(vertices, "nx", "ny", "nz").any()
    assert psnr(picture(found), picture(wanted)) > 90


def test_ply_of_a_solid_gaussian_is_finite() -> None:
    solid = replace(some(2), opacities=torch.tensor([1.0, 0.0]))
    data = ply_bytes(solid)
    assert np.isfinite(np.frombuffer(data[data.index(b"end_header\n") + 11 :], "<f4")).all()


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
        splat_bytes(some(degree=1))


@pytest.fixture
def read_spz() -> Iterator[Callable[[Path], gsply.GSData]]:
    """With its compiled code where the wheel has it: numba takes seconds to compile the other."""
    gsply.use_backend("auto")
    yield gsply.read_spz
    gsply.use_backend("python")


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_spz_as_gsply_reads_it(degree: int, tmp_path: Path, read_spz: Callable[[Path], gsply.GSData]) -> None:
    wanted = some(degree=degree)
    write_gaussians(tmp_path / "set.spz", wanted, format="spz")
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
    # The reader leaves the axes as the file has them: a camera that is turned alike sees the same picture, with
    # directions, and so every sign of every coefficient, as they are in the file.
    camera = RIG["cam01"]
    turned = replace(camera, viewmat=camera.viewmat @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double())
    assert psnr(picture(found, turned), picture(wanted)) > 38
    colors = found.colors(camera.center.float() * half_turn)
    torch.testing.assert_close(colors, wanted.colors(camera.center.float()), atol=0.15, rtol=0)


def test_spz_header() -> None:
    """As the public description has it; positions use the bits that they have."""
    data = gzip.decompress(spz_bytes(some(10, degree=1)))
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
        spz_bytes(replace(some(1), means=torch.tensor([[0.0, value, 0.0]])))


@pytest.mark.parametrize("format", FORMATS)
def test_a_full_disk_leaves_the_old_file(format: Format, tmp_path: Path) -> None:
    path = tmp_path / f"set.{format}"
    path.write_bytes(b"old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))  # files stop at 2000 bytes, as on a full disk
    try:
        with pytest.raises(StorageError, match="cannot be written"):
            write_gaussians(path, some(), format=format)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
