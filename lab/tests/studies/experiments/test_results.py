# SPDX-License-Identifier: Apache-2.0
"""Results go to files and come back; a file is there whole or not at all, and foreign ones are refused."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from outcomes import outcome
from structgstream.errors import StorageError
from structgstream.evaluation.report import FrameScores, Report, Scores
from structgstream_studies.experiments.results import read_result, read_results, result_of, round_floats, write_result


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    path, result = tmp_path / "deep" / "er" / "v.seed3.json", outcome("v", 3, psnr=31.25)
    write_result(path, result)
    found = read_result(path)
    assert found == result
    assert found is not None
    assert (found.key, found.seed, found.capture) == ("v", 3, "ring")
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_floats_are_rounded_to_six_digits_and_nothing_else_is(tmp_path: Path) -> None:
    assert round_floats(3.14159265) == 3.14159
    assert round_floats({"a": [1e-9 / 3, (2 / 3, "x")], "n": 123456789, "t": True, "z": None}) == {
        "a": [3.33333e-10, [0.666667, "x"]],
        "n": 123456789,
        "t": True,
        "z": None,
    }
    write_result(tmp_path / "r.json", outcome("v", psnr=100 / 3))
    assert json.loads((tmp_path / "r.json").read_text())["mean"]["psnr"] == 33.3333


def test_writing_that_breaks_off_leaves_the_old_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "r.json"
    write_result(path, outcome("v", psnr=30.0))

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(StorageError, match=r"r\.json cannot be written \(No space left on device\)"):
        write_result(path, outcome("v", psnr=20.0))
    monkeypatch.undo()
    found = read_result(path)
    assert found is not None
    assert found.mean["psnr"] == 30.0
    assert read_results(tmp_path) == [found]


def test_no_result_is_none(tmp_path: Path) -> None:
    assert read_result(tmp_path / "nothing.json") is None


@pytest.mark.parametrize(
    "content",
    [b"", b"hello", b"[1, 2]", b'{"identity": {}}', b'{"name": "somebody", "version": 3}', b"\xff\xfe\x00", b"7"],
)
def test_foreign_files_are_refused_with_what_to_do(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "package.json"
    path.write_bytes(content)
    with pytest.raises(StorageError, match=r"package\.json is not a result of an experiment; remove it and run again"):
        read_result(path)


def test_a_folder_in_the_place_of_a_result_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="cannot be read"):
        read_result(tmp_path)


def test_results_of_a_folder_are_in_order(tmp_path: Path) -> None:
    other = outcome("a", 0, capture={"name": "arc"})
    for number, result in enumerate([outcome("b", 1), outcome("b", 0), outcome("a", 9), other]):
        write_result(tmp_path / f"folder{number}" / "r.json", result)
    assert [(one.capture, one.key, one.seed) for one in read_results(tmp_path)] == [
        ("arc", "a", 0),
        ("ring", "a", 9),
        ("ring", "b", 0),
        ("ring", "b", 1),
    ]


def small_report() -> Report:
    """Three frames of 1000, 100 and 300 bytes, of which 0, 10 and 30 are of free Gaussians; the last has no log."""
    scores = Scores(30.0, 0.9, 31.0, None, 30.0, 0.0, 0.1)
    logs = [{"total_seconds": 50.0, "cpu_seconds": 60.0, "seconds": {}}, {"total_seconds": 2.0, "cpu_seconds": 3.0}, {}]
    frames = [
        FrameScores(
            index=index,
            pts_seconds=index / 30,
            kind="delta" if index else "key",
            bytes=size,
            field_bytes={"free_means": free // 2, "free_quats": free // 2, "feature": size - free},
            anchors=5,
            free=index,
            decode_seconds=0.001,
            cameras={"a": scores},
            mean=replace(scores, psnr=30.0 - index),
            log=log,
        )
        for index, (size, free, log) in enumerate(zip((1000, 100, 300), (0, 10, 30), logs))
    ]
    return Report(
        frames,
        {"a": scores},
        scores,
        {"metadata": {"capture": "x"}, "total_bytes": 1400, "not_available": {"lpips": "in /some/folder"}},
        {"cpu": "c"},
    )


def test_a_result_of_a_report_has_the_costs_of_the_frames_after_the_first() -> None:
    result = result_of(small_report(), identity={"key": "v", "seed": 1}, trained_by={"cpu": "d"})
    online = {key: value for key, value in result.mean.items() if key.startswith("online")}
    assert online == {
        "online_bytes": 200.0,
        "online_free_bytes": 20.0,
        "online_seconds": 2.0,
        "online_cpu_seconds": 3.0,
    }
    assert result.mean["first_cpu_seconds"] == 60.0
    assert result.stream == {"total_bytes": 1400, "not_available": ["lpips"]}
    assert [frame["psnr"] for frame in result.frames] == [30.0, 29.0, 28.0]
    assert [frame.get("cpu_seconds") for frame in result.frames] == [60.0, 3.0, None]
    assert all(key not in frame for frame in result.frames for key in ("log", "cameras", "seconds"))
    assert (result.environment, result.trained_by) == ({"cpu": "c"}, {"cpu": "d"})


def test_one_frame_alone_has_no_costs_after_the_first() -> None:
    report = small_report()
    result = result_of(replace(report, frames=report.frames[:1]), identity={}, trained_by={})
    assert result.mean["online_bytes"] is None
    assert result.mean["online_cpu_seconds"] is None
