# SPDX-License-Identifier: Apache-2.0
"""Files of ours opened by a reader that is not: plyfile; and numbered files of other trainers, read or refused."""

import io
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from structgstream.errors import CaptureError
from structgstream.exporters.bake import BakedGaussians
from structgstream.exporters.formats import FrameOptions
from structgstream.exporters.ply import find_sequence, ply_bytes, read_header, read_ply
from structgstream.exporters.write import write_gaussians
from tests.support.plain import picture, psnr, some


def column(vertices: np.ndarray, *names: str) -> Tensor:
    return torch.from_numpy(np.stack([np.asarray(vertices[name]) for name in names], axis=1).astype(np.float32))


def assert_same(found: BakedGaussians, wanted: BakedGaussians) -> None:
    for field in fields(BakedGaussians):
        torch.testing.assert_close(getattr(found, field.name), getattr(wanted, field.name), rtol=1e-5, atol=1e-6)


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
    assert_same(found, wanted)
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


@pytest.mark.parametrize(("degree", "newline"), [(0, b"\n"), (3, b"\r\n")])
def test_another_library_s_file(degree: int, newline: bytes, tmp_path: Path) -> None:
    """Properties in another order and of other types, one more of them, and a second element."""
    wanted = some(20, degree=degree)
    (tmp_path / "ours.ply").write_bytes(ply_bytes(wanted, FrameOptions()))
    ours = PlyData.read(str(tmp_path / "ours.ply"))["vertex"].data
    names = [name for name in reversed(ours.dtype.names) if not name.startswith("n")]
    rows = np.empty(20, [("label", "u1"), *((name, "f8" if name == "x" else "f4") for name in names)])
    for name in names:
        rows[name] = ours[name]
    other = PlyElement.describe(np.zeros(2, [("x", "f4")]), "other")
    PlyData([PlyElement.describe(rows, "vertex"), other], byte_order="<").write(str(tmp_path / "theirs.ply"))
    head, end, body = (tmp_path / "theirs.ply").read_bytes().partition(b"end_header\n")
    (tmp_path / "theirs.ply").write_bytes((head + end).replace(b"\n", newline) + body)
    assert read_header(tmp_path / "theirs.ply").unread == ("label", "element other")
    found = read_ply(tmp_path / "theirs.ply")
    assert_same(found, wanted)


def test_files_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (0, 5, 10, 100, 15, *range(20, 100, 5)):
        (tmp_path / f"point_cloud_{number}.{'PLY' if number == 5 else 'ply'}").touch()
        (tmp_path / f"._point_cloud_{number}.ply").touch()
    assert [file.stem for file in find_sequence(tmp_path)] == [f"point_cloud_{n}" for n in range(0, 101, 5)]


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ((), "is no folder with numbered .ply files"),
        (("a_0", "a_1", "a_3", "a_5"), "2 of 6 frames are missing .* the first is number 2"),
        (("a_0", "b_1"), "more than one sequence, aN.ply and bN.ply|more than one sequence, a_N.ply and b_N.ply"),
        (("a_1", "a_01"), "have the same number"),
        (("a_0", "mean"), r"mean\.ply has no number"),
    ],
)
def test_sequences_that_are_none(names: tuple[str, ...], words: str, tmp_path: Path) -> None:
    for name in names:
        (tmp_path / f"{name}.ply").touch()
    with pytest.raises(CaptureError, match=words):
        find_sequence(tmp_path)


GOOD = ply_bytes(some(5, degree=1), FrameOptions())


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is not a .ply file"),
        (GOOD.replace(b"binary_little_endian", b"ascii"), "not binary little endian"),
        (GOOD.replace(b"element vertex 5", b"element chunk 5"), "it is a compressed .ply of SuperSplat"),
        (GOOD.replace(b"float rot_2\n", b"float turn\n"), "lacks the property rot_2"),
        (GOOD.replace(b"property float opacity\n", b""), "lacks the property opacity"),
        (GOOD.replace(b"f_rest_8\n", b"f_more_8\n"), "has 8 properties f_rest|lacks the property f_rest"),
        (GOOD.replace(b"float x\n", b"quad x\n"), "of unknown types"),
        (GOOD[:-100], "ends after 4 of 5 Gaussians"),
        (GOOD.replace(b"vertex 5", b"vertex 5" + b"0" * 15), "ends after 5 of 5000000000000000 Gaussians"),
        (GOOD.replace(b"vertex 5", b"vertex"), "does not begin with an element vertex"),
        (GOOD.replace(b"float nx\n", b"float x\n"), "two properties of one name"),
        (
            ply_bytes(replace(some(5), means=torch.full((5, 3), torch.inf)), FrameOptions()),
            "5 of 5 Gaussians of .* finite",
        ),
        (
            ply_bytes(replace(some(5), quats=torch.full((5, 4), torch.nan)), FrameOptions()),
            "5 of 5 Gaussians of .* finite",
        ),
    ],
)
def test_files_that_cannot_be_read(data: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / "frame_0.ply").write_bytes(data)
    with pytest.raises(CaptureError, match=words):
        read_ply(tmp_path / "frame_0.ply")
