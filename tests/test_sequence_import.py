# SPDX-License-Identifier: Apache-2.0
"""Imported sequences: what a reader of the stream gets, against the files."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from structgstream import sequence_import
from structgstream.cli import main
from structgstream.codec.packets import PacketKind
from structgstream.codec.reader import open_stream
from structgstream.errors import CaptureError
from structgstream.exporters.bake import BakedGaussians
from structgstream.exporters.formats import FrameOptions
from structgstream.exporters.ply import ply_bytes
from structgstream.exporters.write import write_gaussians
from structgstream.harmonics import Y0
from structgstream.sequence_import import ImportedSequence, import_sequence, ring_around
from tests.support.backends import quickest_backend
from tests.support.plain import some
from tests.support.rigs import arc_rig

RIG = arc_rig(4, width=64, height=48)


def write(folder: Path, parts: Sequence[BakedGaussians]) -> list[Path]:
    return [write_gaussians(folder / f"frame_{t}.ply", part, format="ply") for t, part in enumerate(parts)]


def imported(folder: Path, parts: Sequence[BakedGaussians], *, max_splats: int | None = None) -> ImportedSequence:
    files = write(folder, parts)
    output, backend = folder / "out.sgs", quickest_backend()
    return import_sequence(files, output, fps=2.0, backend=backend, rig=RIG, max_splats=max_splats)


def check(path: Path, parts: Sequence[BakedGaussians]) -> None:
    """Every frame has the Gaussians of its file, in the units of the files."""
    with open_stream(path) as reader:
        assert len(reader.packets) == len(parts)
        pixel = 3.0 / 40.0
        for index, wanted in enumerate(parts):
            free = reader.scene(index).free
            means = reader.header.similarity.inverse_points(free.means.double()).float()
            nearest = torch.cdist(wanted.means, means).argmin(1)
            assert len(free) == len(wanted)
            torch.testing.assert_close(means[nearest], wanted.means, atol=0.1 * pixel, rtol=0)
            scales = free.log_scales[nearest].exp() / reader.header.similarity.scale
            torch.testing.assert_close(scales, wanted.scales, atol=0, rtol=0.02)
            torch.testing.assert_close(free.logit_opacities[nearest].sigmoid(), wanted.opacities, atol=0.01, rtol=0)
            color = (0.5 + Y0 * wanted.sh[:, 0]).clamp(min=0.0)
            torch.testing.assert_close(free.colors[nearest], color, atol=0.003, rtol=0)


def moving(count: int = 4) -> list[BakedGaussians]:
    base = some(80)
    return [replace(base, means=base.means + 0.02 * t, quats=base.quats * (-1) ** t) for t in range(count)]


def test_the_same_gaussians_live_on(tmp_path: Path) -> None:
    found = imported(tmp_path, moving())
    assert found.linked
    assert (found.frames, found.counts, found.degree) == (4, (80, 80), 0)
    assert found.psnr > 35
    assert found.color_psnr > found.psnr
    check(tmp_path / "out.sgs", moving())
    with open_stream(tmp_path / "out.sgs") as reader:
        kinds = [packet.kind for packet in reader.packets]
        assert kinds == [PacketKind.KEY, PacketKind.DELTA] * 2, "a key packet each second"
        assert reader.packets[1].bytes < 0.5 * reader.packets[0].bytes
        assert torch.equal(reader.scene(3).free.births, torch.arange(80))


@pytest.mark.parametrize("counts", [(80, 79, 81), (80, 80, 80)])
def test_other_gaussians_are_frames_of_their_own(counts: tuple[int, ...], tmp_path: Path) -> None:
    """Other counts, or equal counts in another order."""
    g = torch.Generator().manual_seed(0)
    parts = [some(n).select(torch.randperm(n, generator=g)) for n in counts]
    found = imported(tmp_path, parts)
    assert not found.linked
    assert found.counts == (min(counts), max(counts))
    check(tmp_path / "out.sgs", parts)
    with open_stream(tmp_path / "out.sgs") as reader:
        assert {packet.kind for packet in reader.packets} == {PacketKind.KEY}
        births = torch.cat([reader.scene(t).free.births for t in range(3)])
        assert len(births.unique()) == len(births)


def test_what_harmonics_lose_is_reported(tmp_path: Path) -> None:
    found = imported(tmp_path, [some(80, degree=2)])
    assert found.degree == 2
    assert 15 < found.color_psnr < 40


def test_a_budget_leaves_the_most_important(tmp_path: Path) -> None:
    parts = moving(2)
    assert imported(tmp_path, parts, max_splats=30).counts == (30, 30)
    rows = parts[0].by_importance()[:30]
    check(tmp_path / "out.sgs", [part.select(rows) for part in parts])


def test_what_a_stream_cannot_hold_is_left_out_only_where_that_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sequence_import, "MAX_FREE", 50)
    with pytest.raises(CaptureError, match="80 Gaussians, and a stream at most 50; add --max-splats 50"):
        imported(tmp_path, moving(1))
    assert imported(tmp_path, moving(1), max_splats=50).counts == (50, 50)


@pytest.mark.parametrize("linked", [True, False])
def test_what_is_too_far_away_is_left_out_and_flat_gaussians_stay(linked: bool, tmp_path: Path) -> None:
    part = some(80)
    part.means[3], part.scales[5] = torch.tensor([1e7, 0.0, 0.0]), torch.tensor([1e-45, 0.1, 0.1])
    found = imported(tmp_path, [part, part if linked else part.select(torch.arange(79))])
    assert (found.linked, found.far) == (linked, 1)
    assert found.counts == ((79, 79) if linked else (78, 79))
    kept = part.select(torch.tensor([i for i in range(40) if i not in (3, 5)]))
    with open_stream(tmp_path / "out.sgs") as reader:
        means = reader.header.similarity.inverse_points(reader.scene(1).free.means.double()).float()
        assert torch.cdist(kept.means, means).amin(1).max() < 0.01


def test_a_file_that_cannot_be_read_leaves_the_former_stream(tmp_path: Path) -> None:
    imported(tmp_path, moving(2))
    before, files = (tmp_path / "out.sgs").read_bytes(), write(tmp_path, moving(3))
    files[2].write_bytes(files[2].read_bytes()[:-8])
    with pytest.raises(CaptureError):
        import_sequence(files, tmp_path / "out.sgs", fps=2.0, backend=quickest_backend(), rig=RIG)
    assert (tmp_path / "out.sgs").read_bytes() == before
    assert not (tmp_path / "out.sgs.partial").exists()


def test_files_that_make_no_stream(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="of different degrees"):
        imported(tmp_path, [some(5), some(5, degree=1)])
    files = write(tmp_path, [some(5), some(5)])
    files[1].write_bytes(ply_bytes(some(5).select(torch.zeros(0, dtype=torch.int64)), FrameOptions()))
    with pytest.raises(CaptureError, match=r"frame_1\.ply has no Gaussian"):
        import_sequence(files, tmp_path / "out.sgs", fps=2.0, backend=quickest_backend(), rig=RIG)
    assert not (tmp_path / "out.sgs").exists()


@pytest.mark.parametrize("down", [(0.0, 1.0, 0.0), (0.0, 0.0, -1.0)])
def test_the_ring_sees_the_gaussians_upright(down: tuple[float, float, float]) -> None:
    gaussians = replace(some(200), means=some(200).means * 5 + torch.tensor([10.0, -3.0, 7.0]))
    rig = ring_around(gaussians, down)
    assert len(rig) == 8
    middle = gaussians.means.median(0).values.double()
    for camera in rig.cameras.values():
        seen = camera.viewmat[:3, :3] @ middle + camera.viewmat[:3, 3]
        assert seen[:2].abs().max() < 1e-6
        assert seen[2] > camera.near
        assert (camera.viewmat[:3, :3] @ torch.tensor(down, dtype=torch.float64))[1] > 0.9
        assert (camera.center - middle) @ torch.tensor(down, dtype=torch.float64) < 0


def test_what_a_stream_does_not_have_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Files of Mip-Splatting, whose ``filter_3D`` widens Gaussians, and of dynamic methods."""
    [file] = write(tmp_path / "set", [some(5)])
    file.write_bytes(file.read_bytes().replace(b"float nz\n", b"float filter_3D\n"))
    assert main(["import", str(tmp_path / "set"), "-o", str(tmp_path / "x.sgs"), "--device", "cpu"]) == 0
    assert "Not read, since a plain Gaussian has no such thing: filter_3D." in " ".join(capsys.readouterr().out.split())


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "set", [some(5, degree=1)])
    arguments = ["import", str(tmp_path / "set"), "-o", str(tmp_path / "x.sgs"), "--fps", "12"]
    assert main([*arguments, "--device", "cpu"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "1 frame of 5 Gaussians" in said
    assert "in place of spherical harmonics of degree 1 alone gives" in said
    with open_stream(tmp_path / "x.sgs") as reader:
        assert reader.header.fps == 12.0
    assert main(arguments) == 2
    assert "replace it with --overwrite" in capsys.readouterr().err
    assert main(["import", str(tmp_path), "-o", str(tmp_path / "y.sgs")]) == 1
    assert "is no folder with numbered .ply files" in capsys.readouterr().err
    assert main(["import", str(tmp_path), "-o", str(tmp_path / "y.sgs"), "--fps", "0"]) == 2
