# SPDX-License-Identifier: Apache-2.0
"""Files opened again by a reader that is not ours: plyfile."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData
from torch import Tensor

from structgstream.exporters.bake import BakedGaussians
from structgstream.exporters.formats import FrameOptions
from structgstream.exporters.ply import ply_bytes
from structgstream.exporters.write import write_gaussians
from tests.support.plain import picture, psnr, some


def column(vertices: np.ndarray, *names: str) -> Tensor:
    return torch.from_numpy(np.stack([np.asarray(vertices[name]) for name in names], axis=1).astype(np.float32))


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_ply_as_plyfile_reads_it(degree: int, tmp_path: Path) -> None:
    wanted = some(degree=degree)
    assert write_gaussians(tmp_path / "a" / "set.ply", wanted, format="ply").is_file()
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
    data = ply_bytes(solid, FrameOptions())
    assert np.isfinite(np.frombuffer(data[data.index(b"end_header\n") + 11 :], "<f4")).all()


def test_padding_adds_zeros_up_to_degree_three() -> None:
    wanted = some(5, degree=1)
    vertices = PlyData.read(io.BytesIO(ply_bytes(wanted, FrameOptions(pad_sh=True))))["vertex"]
    rest = column(vertices, *(f"f_rest_{i}" for i in range(45))).reshape(5, 3, 15)
    torch.testing.assert_close(rest[:, :, :3], wanted.sh[:, 1:].transpose(1, 2))
    assert not rest[:, :, 3:].any()
