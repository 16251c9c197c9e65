# SPDX-License-Identifier: Apache-2.0
"""The package's functions beside the commands: the same bytes, the capture's units, one sentence for mistakes."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args, get_type_hints

import numpy as np
import pytest
import torch

import structgstream
from structgstream.cli import main
from structgstream.errors import BackendError, CaptureError, ConfigError, StorageError, StreamError
from structgstream.evaluation.report import as_json
from structgstream.evaluation.run_log import log_path, read_log
from structgstream.kernels.backend import select_backend
from tests.support.backends import QUICKEST
from tests.support.small_clip import small_clip_path
from tests.support.small_presets import QUICK

CLIP = small_clip_path()
PART: dict[str, Any] = {"frames": 2, "scale": 0.25, "backend": QUICKEST}


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames of 80x60 pixels, hardly trained."""
    path = tmp_path_factory.mktemp("stream") / "clip.sgs"
    reported = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(structgstream.PRESETS, "tiny", QUICK)
        reports = structgstream.reconstruct(str(CLIP), path, preset="tiny", on_frame=reported.append, **PART)
    assert reports == reported
    assert [report.index for report in reports] == [0, 1]
    return path


def test_the_bytes_are_those_of_the_command(stream: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(structgstream.PRESETS, "tiny", QUICK)
    arguments = ["reconstruct", str(CLIP), "-o", str(tmp_path / "command.sgs"), "--preset", "tiny"]
    assert main([*arguments, "--frames", "2", "--scale", "0.25", "--device", QUICKEST]) == 0
    assert stream.read_bytes() == (tmp_path / "command.sgs").read_bytes()
    logs = [read_log(path) for path in (stream, tmp_path / "command.sgs")]
    assert [*logs[0]] == [0, 1]
    assert [entry.keys() for entry in logs[0].values()] == [entry.keys() for entry in logs[1].values()]


def test_a_stream_that_was_cut_goes_on(stream: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(structgstream.PRESETS, "tiny", QUICK)
    path, first = tmp_path / "again.sgs", structgstream.open_stream(stream).packets[0]
    path.write_bytes(stream.read_bytes()[: first.offset + first.bytes])
    log_path(path).write_text(log_path(stream).read_text().splitlines(keepends=True)[0])
    with pytest.raises(StorageError, match="exists"):
        structgstream.reconstruct(CLIP, path, preset="tiny", **PART)
    reports = structgstream.reconstruct(CLIP, path, preset="tiny", resume=True, **PART)
    assert [report.index for report in reports] == [1]
    assert path.read_bytes() == stream.read_bytes()
    assert [*read_log(path)] == [0, 1]


def test_a_capture_that_is_open(stream: Path, tmp_path: Path) -> None:
    source = structgstream.open_capture(CLIP, frames=1, scale=0.25)
    wishes: list[dict[str, Any]] = [{"frames": 1}, {"every": 2}]
    for chosen in wishes:
        with pytest.raises(ConfigError, match="open_capture takes them"):
            structgstream.reconstruct(source, tmp_path / "x.sgs", **chosen)
    structgstream.reconstruct(source, tmp_path / "x.sgs", preset=QUICK, backend=QUICKEST)
    ours, theirs = structgstream.open_stream(tmp_path / "x.sgs"), structgstream.open_stream(stream)
    assert torch.equal(ours.scene(0).anchors.positions, theirs.scene(0).anchors.positions)


@pytest.mark.parametrize(
    ("wishes", "words"),
    [
        ({"preset": "tny"}, "there is no preset 'tny'; there are paper-n3dv"),
        ({"preset": "rig", "mbits": 5.0}, "the codec compact"),
        ({"preset": replace(QUICK, codec="raw"), "quality": 1.0}, "this configuration makes one with the codec raw"),
        ({"quality": 90.0}, "not one of -6 to 6"),
        ({"resume": True, "overwrite": True}, "choose one"),
        ({"scale": 3.0}, "(0, 1]"),
        ({"sink": "folder"}, "sink is 'file' or 'segments'; got 'folder'"),
        ({"preset": Path("tiny")}, "preset is a name or a StreamConfig"),
    ],
)
def test_wrong_wishes_are_reported_before_anything_is_written(
    tmp_path: Path, wishes: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        structgstream.reconstruct(CLIP, tmp_path / "x.sgs", **wishes)
    assert words in str(caught.value)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("wishes", "words"),
    [
        ({"metrics": "LPIPS"}, "metrics is one of all, basic; got 'LPIPS'"),
        ({"cameras": "cam00"}, r"cameras takes a list of names, as \('cam00',\)"),
        ({"backend": "cuda:0"}, "no back-end 'cuda:0'; there are auto, cuda, cpu, reference"),
    ],
)
def test_wrong_wishes_of_scores_are_reported(stream: Path, wishes: dict[str, Any], words: str) -> None:
    with pytest.raises((BackendError, ConfigError), match=words):
        structgstream.evaluate(stream, CLIP, **wishes)


def test_pictures_are_asked_for_by_a_camera_or_its_name(stream: Path) -> None:
    """In the units of the capture, and of a scene that is decoded once: codec/test_reader.py."""
    reader = structgstream.open_stream(stream)
    name = reader.header.rig.testing[0]
    picture = reader.render(1, name, backend=QUICKEST)
    assert picture.shape == (60, 80, 3)
    assert picture.dtype == np.uint8
    assert np.array_equal(picture, reader.render(1, reader.header.rig[name], backend=select_backend(QUICKEST)))
    with pytest.raises(ConfigError, match="no camera 'cam77'; it has cam00"):
        reader.render(0, "cam77", backend=QUICKEST)
    with pytest.raises(StreamError, match="there is no frame 2"):
        reader.render(2, name, backend=QUICKEST)


def test_scores_are_those_of_the_command(stream: Path, tmp_path: Path) -> None:
    report = structgstream.evaluate(stream, CLIP, metrics="basic", backend=QUICKEST)
    assert isinstance(report, structgstream.Report)
    assert [*report.cameras] == ["cam00"]
    assert all(isinstance(frame, structgstream.FrameScores) and frame.log for frame in report.frames)
    opened = structgstream.open_capture(CLIP, frames=2, scale=0.25)
    same = structgstream.evaluate(stream, opened, metrics="basic", backend=QUICKEST)
    assert report.mean.psnr_stored is not None
    assert same.mean.psnr_stored is None  # the folder alone has the larger pictures
    others = {"render_seconds", "seconds", "psnr_stored", "ssim_stored"}
    first, second = ({k: v for k, v in as_json(one)["mean"].items() if k not in others} for one in (report, same))
    assert first == second


def test_exports(stream: Path, tmp_path: Path) -> None:
    page = structgstream.export(stream, tmp_path / "clip.html")
    assert "<structgstream-player" in page.read_text()
    flat = structgstream.FrameOptions(degree=0)
    frame = structgstream.export(stream, tmp_path / "one.spz", frame=1, options=flat, backend=QUICKEST)
    folder = structgstream.export(stream, tmp_path / "all", format="spz", options=flat, backend=QUICKEST)
    assert [entry.name for entry in sorted(folder.iterdir())] == ["frame_000000.spz", "frame_000001.spz"]
    assert frame.read_bytes() == (folder / "frame_000001.spz").read_bytes()
    with pytest.raises(ConfigError, match="contains one frame"):
        structgstream.export(stream, tmp_path / "two.ply", backend=QUICKEST)
    with pytest.raises(ConfigError, match="a page contains the whole stream"):
        structgstream.export(stream, tmp_path / "x.html", frame=0)
    with pytest.raises(ConfigError, match="give one of them"):
        structgstream.export(stream, tmp_path / "x", frame=0, frames=(0, 1))


def classes_in(hint: Any) -> set[type]:
    """The package's own classes in a type, those that are inside of others too."""
    found = {kind for part in get_args(hint) for kind in classes_in(part)}
    return found | ({hint} if isinstance(hint, type) and hint.__module__.startswith("structgstream") else set())


def test_what_is_returned_is_exported() -> None:
    returned = set[type]()
    for function in (
        structgstream.reconstruct,
        structgstream.evaluate,
        structgstream.export,
        structgstream.open_stream,
    ):
        returned |= classes_in(get_type_hints(function)["return"])
    for kind in [*returned]:
        for hint in get_type_hints(kind).values():
            returned |= classes_in(hint)
    assert {kind.__name__ for kind in returned} >= {"FrameReport", "FrameScores", "Report", "Scores", "StreamReader"}
    assert not {kind.__name__ for kind in returned} - {*structgstream.__all__}


@pytest.mark.parametrize(("sink", "seconds"), [("file", 5.0), ("segments", -5.0)])
def test_a_window_that_cannot_be_is_refused(tmp_path: Path, sink: Literal["file", "segments"], seconds: float) -> None:
    with pytest.raises(ConfigError, match=f"window_seconds is a positive number .* got {seconds:g} for sink='{sink}'"):
        structgstream.reconstruct(tmp_path, tmp_path / "out", sink=sink, window_seconds=seconds)


def test_a_capture_that_cannot_be_opened_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(CaptureError):
        structgstream.reconstruct(tmp_path / "missing", tmp_path / "out", sink="segments")
    assert not any(tmp_path.iterdir())
