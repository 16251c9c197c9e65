# SPDX-License-Identifier: Apache-2.0
"""The command ``render``: cameras and paths, as videos and pictures."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import pytest

from structgstream.cli import main, render
from structgstream.cli.options import parse_options
from structgstream.codec.reader import StreamReader, open_stream
from structgstream.codec.sinks import FileSink
from structgstream.evaluation.camera_path import central_camera
from tests.support.backends import QUICKEST
from tests.support.drawn import pixels_of
from tests.support.quick_streams import CLIP, Runner
from tests.support.streams import header_for, small_scene, small_stream, write_stream


def test_render_a_camera_to_video_and_pictures(stream: Path, tmp_path: Path) -> None:
    base = ["render", str(stream), "--device", QUICKEST, "-o"]
    assert main([*base, str(tmp_path / "v.mp4")]) == 0
    with av.open(str(tmp_path / "v.mp4")) as container:
        assert len(list(container.decode(video=0))) == 3
    assert main([*base, str(tmp_path / "all"), "--camera", "cam03"]) == 0
    assert sorted(entry.name for entry in (tmp_path / "all").iterdir()) == ["00000.png", "00001.png", "00002.png"]
    assert main([*base, str(tmp_path / "one.png"), "--camera", "cam03", "--frame", "1"]) == 0
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "all" / "00001.png").read_bytes()


@pytest.mark.parametrize("path", ["orbit", "arc"])
def test_render_a_path_beside_the_stream(stream: Path, tmp_path: Path, path: str) -> None:
    copy = tmp_path / "ball.sgs"
    shutil.copy(stream, copy)
    assert main(["render", str(copy), "--path", path, "--seconds", "0.2", "--device", QUICKEST]) == 0
    with av.open(str(tmp_path / f"ball-{path}.mp4")) as container:
        assert len(list(container.decode(video=0))) == 6


def test_render_beside_the_truth(stream: Path, tmp_path: Path) -> None:
    out = tmp_path / "side.png"
    arguments = ["render", str(stream), CLIP, "--compare", "--frame", "2", "-o", str(out), "--device", QUICKEST]
    assert main(arguments) == 0
    assert pixels_of(out).shape == (60, 3 * 80 + 8, 3)


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["--camera", "cam99"], "no camera 'cam99'"),
        (["--frame", "7", "-o", "x.png"], "frames 0 to 2"),
        (["-o", "x.png"], "--frame"),
        (["--compare"], "needs the capture"),
        (["--between", "cam01", "cam02"], "--path arc"),
        ([CLIP], "only used with --compare"),
        (["--seconds", "3"], "--seconds is the duration of a --path"),
        *((["--path", "orbit", "--seconds", text], "above 0") for text in ("0", "-3", "nan", "inf", "1e9")),
    ],
)
def test_render_refuses_what_does_not_go_together(stream: Path, extra: list[str], words: str, run: Runner) -> None:
    assert words in run(["render", str(stream), *extra, "--device", QUICKEST], status=2).err


@pytest.mark.parametrize(
    ("times", "count", "frames"),
    [
        ((0, 1, 2), 6, [(0, 0), (1, 1), (2, 1), (3, 2), (4, 1), (5, 1)]),
        ((0, 1, 2), 2, [(0, 0), (1, 1)]),
        ((0, 1, 5), 6, [(0, 0), (1, 1), (5, 2)]),
    ],
)
def test_time_on_a_path_runs_with_the_camera_or_forth_and_back(
    times: tuple[int, ...], count: int, frames: list[tuple[int, int]]
) -> None:
    """Views and frames of a path as long as the stream, which may lack frames, and of a longer one."""
    packets = [SimpleNamespace(pts_seconds=time / 30) for time in times]
    reader: Any = SimpleNamespace(
        packets=SimpleNamespace(at=packets.__getitem__),
        runs=[range(3)],
        header=SimpleNamespace(fps=30.0),
        scene=lambda number: number,
    )
    views: Any = range(count)
    assert list(render._along(reader, views, None)) == frames


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ([], "ball-cam00.mp4"),
        (["--camera", "cam02"], "ball-cam02.mp4"),
        (["--camera", "cam02", "--frame", "1"], "ball-cam02-1.png"),
        (["--path", "orbit", "--frame", "1"], "ball-orbit.mp4"),
        (["x", "--compare"], "ball-cam00-compare.mp4"),
        (["x", "--compare", "--frame", "2"], "ball-cam00-compare-2.png"),
    ],
)
def test_the_name_of_a_result(stream: Path, arguments: list[str], name: str) -> None:
    options = parse_options(render.Render, "render", arguments=["videos/ball.sgs", *arguments])
    with open_stream(stream) as reader:
        assert render.default_output(options, reader) == Path("videos") / name


def test_a_stream_without_frames_is_not_rendered_nor_scored(tmp_path: Path, run: Runner) -> None:
    empty = tmp_path / "empty.sgs"
    write_stream(FileSink(empty), [], header=header_for(small_scene()))
    for more in ([], ["--path", "orbit"], ["--frame", "0"]):
        assert "no whole frame" in run(["render", str(empty), *more], status=2).err
    assert "no whole frame, so there is nothing to score" in run(["evaluate", str(empty), CLIP], status=2).err


def test_lost_frames_are_left_out(tmp_path: Path, run: Runner) -> None:
    """As they are in a stream with a window; here packets are damaged, and no index is whole."""
    data = bytearray(small_stream(frames=5)[:-1])
    for lost in (0, 2):
        data[StreamReader(bytes(data)).packets.at(lost).offset + 20] ^= 1
    (tmp_path / "late.sgs").write_bytes(data)
    base = ["render", str(tmp_path / "late.sgs"), "--device", QUICKEST]
    left_out = "The stream has frames 1 to 1 and 3 to 4; those that are lost are left out."
    assert left_out in run([*base, "-o", str(tmp_path / "all")]).err
    assert sorted(entry.name for entry in (tmp_path / "all").iterdir()) == [f"0000{i}.png" for i in (1, 3, 4)]
    assert main([*base, "-o", str(tmp_path / "3.png"), "--frame", "3"]) == 0
    assert (tmp_path / "3.png").read_bytes() == (tmp_path / "all" / "00003.png").read_bytes()
    for path in ([], ["--path", "orbit", "--seconds", "0.1"]):
        assert main([*base, "-o", str(tmp_path / "v.mp4"), *path]) == 0
        with av.open(str(tmp_path / "v.mp4")) as container:
            assert [round(30 * one.time) for one in container.decode(video=0)] == [0, 1, 2]
    assert "frames 1 to 1 and 3 to 4; there is no frame 0" in run([*base, "--frame", "0"], status=2).err
    compared = run([base[0], base[1], CLIP, "--compare"], status=2).err
    assert "before the first lost one, which is frame 0" in compared
    scored = run(["evaluate", base[1], CLIP], status=2).err
    assert "frame 0 of the stream is lost or no longer stored, and scores begin with it" in scored


def test_a_video_that_is_there_stays_when_the_frame_is_not(stream: Path, tmp_path: Path) -> None:
    """Whether it can be rendered is known before the file is opened."""
    (tmp_path / "old.mp4").write_bytes(b"precious")
    for more in (["--frame", "9"], ["--camera", "nobody"], ["--path", "orbit", "--frame", "9"]):
        assert main(["render", str(stream), "-o", str(tmp_path / "old.mp4"), *more]) == 2
    assert (tmp_path / "old.mp4").read_bytes() == b"precious"


def test_the_camera_in_the_middle_where_none_is_held_out(stream: Path) -> None:
    with open_stream(stream) as reader:
        assert render.choose_camera(reader, None) == "cam00"
        header = replace(reader.header, rig=reader.header.rig.with_held_out(frozenset()))
        without: Any = SimpleNamespace(header=header)
        assert render.choose_camera(without, None) == central_camera(header.rig)
