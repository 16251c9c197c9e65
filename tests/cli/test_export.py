# SPDX-License-Identifier: Apache-2.0
"""The command ``export``: which files it writes, in which units, and what it says to wrong requests."""

import base64
import re
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData

from structgstream.cli import main
from structgstream.codec.reader import open_stream
from structgstream.codec.sinks import FileSink
from structgstream.exporters.formats import FORMATS, PAGES
from structgstream.kernels.backend import reference_backend
from structgstream.scene.scene import Scene
from tests.support.quick_streams import Runner
from tests.support.rigs import random_scene
from tests.support.streams import compact_header, header_for, write_stream

FRAMES = 3


def frames_of_a_scene(anchors: int = 30, free: int = 4) -> list[Scene]:
    """A scene that drifts."""
    scene = random_scene(anchors, free=free, seed=4)
    shift = torch.tensor([0.1, 0.0, 0.0])
    moved = [replace(scene.anchors, positions=scene.anchors.positions + t * shift) for t in range(FRAMES)]
    return [replace(scene, anchors=anchors) for anchors in moved]


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of a small scene."""
    path = tmp_path_factory.mktemp("export") / "small.sgs"
    write_stream(FileSink(path), frames_of_a_scene())
    return path


def test_a_frame_in_the_units_of_the_capture(stream: Path, tmp_path: Path, run: Runner) -> None:
    out = tmp_path / "one.ply"
    said = run(["export", str(stream), "-o", str(out), "--frame", "1", "--device", "reference"]).out
    vertices = PlyData.read(str(out))["vertex"].data
    assert f"{len(vertices):,} Gaussians" in said
    assert [entry.name for entry in tmp_path.iterdir()] == ["one.ply"]
    reader = open_stream(stream)
    header, scene = reader.header, reader.scene(1)
    camera = header.camera(header.rig.training[0])
    drawn = scene.gaussians(camera, reference_backend())
    wanted = header.similarity.inverse_points(drawn.means[drawn.opacities > 0.5])
    found = torch.from_numpy(np.stack([vertices[axis] for axis in "xyz"], axis=1).copy())
    assert len(wanted) > 20
    assert float(torch.cdist(wanted.double(), found.double()).min(1).values.max()) < 1e-5
    assert len([name for name in vertices.dtype.names if name.startswith("f_rest")]) == 9  # degree 1


def test_a_sequence_fills_a_folder(stream: Path, tmp_path: Path) -> None:
    common = ["export", str(stream), "--device", "reference"]
    assert main([*common, "-o", str(tmp_path / "all")]) == 0
    assert main([*common, "-o", str(tmp_path / "two"), "--frames", "1", "2", "--format", "spz"]) == 0
    assert main([*common, "-o", str(tmp_path / "one"), "--frame", "2", "--format", "splat"]) == 0
    assert {str(entry.relative_to(tmp_path)) for entry in tmp_path.rglob("*.*")} == {
        *(f"all/frame_00000{i}.ply" for i in range(3)),
        *(f"two/frame_00000{i}.spz" for i in (1, 2)),
        "one/frame_000002.splat",
    }
    first, last = (PlyData.read(str(tmp_path / "all" / f"frame_00000{i}.ply"))["vertex"]["x"].mean() for i in (0, 2))
    assert last > first + 0.05
    assert main([*common, "-o", str(tmp_path / "one.ply"), "--frame", "2"]) == 0
    assert (tmp_path / "one.ply").read_bytes() == (tmp_path / "all" / "frame_000002.ply").read_bytes()


def test_frames_of_an_earlier_export_in_a_folder_are_named(stream: Path, tmp_path: Path, run: Runner) -> None:
    arguments = ["export", str(stream), "-o", str(tmp_path / "out"), "--device", "reference"]
    assert "earlier export" not in run(arguments).out
    said = " ".join(run([*arguments, "--frames", "0", "1"]).out.split())
    assert "also has 1 frame of an earlier export, such as frame_000002.ply;" in said


def test_a_zip_has_the_files_of_the_folder(stream: Path, tmp_path: Path, run: Runner) -> None:
    common = ["export", str(stream), "--device", "reference", "--sh-degree", "0"]
    assert main([*common, "-o", str(tmp_path / "all")]) == 0
    said = run([*common, "-o", str(tmp_path / "all.zip")]).out
    with zipfile.ZipFile(tmp_path / "all.zip") as archive:
        assert {name: archive.read(name) for name in archive.namelist()} == {
            path.name: path.read_bytes() for path in (tmp_path / "all").iterdir()
        }
    assert "3 frames" in said
    assert re.search(r"of frame 0, against the stream's own pictures: PSNR \d\d\.\d dB at", " ".join(said.split()))


def test_parts_of_a_frame(stream: Path, tmp_path: Path) -> None:
    common = ["export", str(stream), "--frame", "0", "--device", "reference", "--sh-degree", "0", "-o"]

    def vertices(name: str, *options: str) -> np.ndarray:
        assert main([*common, str(tmp_path / name), *options]) == 0
        return PlyData.read(str(tmp_path / name))["vertex"].data

    whole = vertices("whole.ply")
    x = np.sort(whole["x"])[len(whole) // 2]
    half = vertices("half.ply", "--crop", str(x), "-99", "-99", "99", "99", "99")
    assert np.array_equal(half, whole[whole["x"] >= x])
    solid = vertices("solid.ply", "--min-opacity", "0.5")
    assert np.array_equal(solid, whole[whole["opacity"] >= 0])
    few = vertices("few.ply", "--max-splats", "10")
    volumes = whole["scale_0"] + whole["scale_1"] + whole["scale_2"] - np.log1p(np.exp(-whole["opacity"]))
    assert np.array_equal(few, whole[np.sort(np.argsort(-volumes, kind="stable")[:10])])


def test_the_list_of_formats(run: Runner) -> None:
    said = run(["export", "--list"]).out
    assert all(name in said for name in (*FORMATS, *PAGES))
    assert "export needs a stream file" in run(["export"], status=2).err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-o", "x.obj"], "there is no format .obj; there are ply, splat, spz, sog, glb, usd, 4dgs"),
        (["-o", "x.ply"], "contains one frame"),
        (["-o", "x.ply", "--frame", "3"], "frames 0 to 2; there is no frame 3"),
        (["-o", "x", "--frames", "2", "1"], "2 comes after 1"),
        (["-o", "x.ply", "--frame", "0", "--format", "spz"], "asks for .ply, and --format for spz"),
        (["-o", "x.html", "--frame", "0"], "a page contains the whole stream"),
        (["-o", "x", "--format", "html"], "a file whose name ends in .html, unlike x"),
        (["-o", "x.ply", "--format", "html"], "a file whose name ends in .html, unlike x.ply"),
        (["-o", "x.html", "--format", "ply"], "asks for .html, and --format for ply"),
        (["-o", "x.ply", "--frame", "0", "--pad-sh", "--format", "ply", "--max-splats", "0"], "leaves no Gaussian"),
    ],
)
def test_wrong_requests(
    stream: Path, arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Runner
) -> None:
    monkeypatch.chdir(tmp_path)
    assert words in run(["export", str(stream), *arguments], status=2).err
    assert not list(tmp_path.iterdir())


def test_a_page_with_a_player(stream: Path, tmp_path: Path, run: Runner) -> None:
    page = tmp_path / "ball.html"
    said = run(["export", str(stream), "-o", str(page)]).out
    assert f"Wrote {page}" in said
    assert page.as_uri() in said
    text = page.read_text()
    assert base64.b64encode(stream.read_bytes()).decode() in text
    assert "<structgstream-player" in text
    copy = tmp_path / "copy.sgs"
    copy.write_bytes(stream.read_bytes())
    assert main(["export", str(copy), "--format", "html"]) == 0
    assert (tmp_path / "copy.html").read_text() == text.replace("<title>small<", "<title>copy<")


def test_a_folder_for_a_web_server(stream: Path, tmp_path: Path, run: Runner) -> None:
    said = run(["export", str(stream), "-o", str(tmp_path / "on.line"), "--format", "site"]).out
    assert "put the folder on any web server" in said
    assert (tmp_path / "on.line" / "stream.sgs").read_bytes() == stream.read_bytes()
    assert (tmp_path / "on.line" / "index.html").is_file()


def test_of_a_damaged_stream_what_can_be_shown(tmp_path: Path, run: Runner) -> None:
    scenes = frames_of_a_scene(anchors=8, free=2) * 3
    header = compact_header(scenes[0])
    whole = tmp_path / "whole.sgs"
    write_stream(FileSink(whole), scenes, header=header)
    data = bytearray(whole.read_bytes())
    data[open_stream(whole).packets[4].offset + 30] ^= 1  # Frame 6 is the next key packet.
    damaged = tmp_path / "damaged.sgs"
    damaged.write_bytes(data)
    common = ["export", str(damaged), "--device", "reference", "-o"]
    assert "2 of 9 frames are lost, the first is 4" in run([*common, str(tmp_path / "all")]).out
    assert sorted(entry.stem for entry in (tmp_path / "all").iterdir()) == [
        f"frame_{i:06d}" for i in (0, 1, 2, 3, 6, 7, 8)
    ]
    assert main([*common, str(tmp_path / "some"), "--frames", "6", "7"]) == 0
    assert len(list((tmp_path / "some").iterdir())) == 2
    assert "is damaged" in run([*common, str(tmp_path / "x.ply"), "--frame", "4"], status=1).err
    assert main([*common, str(tmp_path / "x.ply"), "--frame", "8"]) == 0


def test_problems_of_the_stream_and_of_the_disk(stream: Path, tmp_path: Path, run: Runner) -> None:
    empty = tmp_path / "empty.sgs"
    scenes = frames_of_a_scene(anchors=0, free=0)
    write_stream(FileSink(empty), scenes, header=header_for(scenes[0]))
    crop = ["--frame", "0", "--crop", "90", "90", "90", "99", "99", "99"]
    assert "leave none of" in run(["export", str(stream), *crop, "-o", str(tmp_path / "x.ply")], status=1).err
    assert "nothing to export" in run(["export", str(empty), "--frame", "0"], status=1).err
    assert "no such" in run(["export", str(tmp_path / "none.sgs")], status=1).err.lower()
    (tmp_path / "file").write_text("")
    for name in ("x.ply", "x.zip", "x.usd"):
        inside = ["export", str(stream), "-o", str(tmp_path / "file" / name), "--frame", "0"]
        assert f"{name} cannot be written (" in run(inside, status=1).err
    assert {entry.name for entry in tmp_path.iterdir()} == {"empty.sgs", "file"}
