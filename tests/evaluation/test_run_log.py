# SPDX-License-Identifier: Apache-2.0
"""The trainer's log survives crashes and resumed runs."""

from pathlib import Path

import pytest

from structgstream.errors import StorageError
from structgstream.evaluation.run_log import append_log, begin_log, log_of, log_path, read_log
from tests.support.killed import folders_of_the_killed


def test_lines_come_back_by_frame(tmp_path: Path) -> None:
    stream = tmp_path / "ball.sgs"
    assert read_log(stream) == {}
    begin_log(stream)
    for index in range(3):
        append_log(stream, {"index": index, "seconds": {"render": 0.5}})
    assert log_path(stream).name == "ball.log.jsonl"
    assert sorted(read_log(stream)) == [0, 1, 2]
    assert read_log(stream)[1]["seconds"] == {"render": 0.5}


def test_a_cut_line_is_dropped_and_a_resumed_run_goes_on_after_it(tmp_path: Path) -> None:
    stream = tmp_path / "ball.sgs"
    begin_log(stream)
    for index in range(3):
        append_log(stream, {"index": index, "run": 1})
    with log_path(stream).open("a") as file:
        file.write('{"index": 3, "ru')
    begin_log(stream, frames=2)
    append_log(stream, {"index": 2, "run": 2})
    assert [entry["run"] for entry in read_log(stream).values()] == [1, 1, 2]
    assert len(log_path(stream).read_text().splitlines()) == 3


def test_killed_at_any_step_of_its_beginning_a_resumed_run_keeps_the_lines(tmp_path: Path) -> None:
    def begin(folder: Path) -> None:
        for index in range(4):
            append_log(folder / "ball.sgs", {"index": index})

    resumed = folders_of_the_killed(tmp_path, lambda folder: begin_log(folder / "ball.sgs", frames=3), begin=begin)
    assert all([*read_log(folder / "ball.sgs")][:3] == [0, 1, 2] for folder in resumed)


def test_a_new_run_forgets_the_old_one(tmp_path: Path) -> None:
    stream = tmp_path / "ball.sgs"
    append_log(stream, {"index": 7})
    begin_log(stream)
    assert read_log(stream) == {}


def test_names_with_dots_have_logs_of_their_own(tmp_path: Path) -> None:
    names = ["studio.2026-11-27", "studio.2026-11-28", "studio.sgs", "studio.2026-11-27.mp4"]
    assert len({log_path(tmp_path / name) for name in names}) == len(names)
    assert log_path(tmp_path / "studio.2026-11-28.sgs").name == "studio.2026-11-28.log.jsonl"


@pytest.mark.parametrize("side", ["log", "metrics"])
def test_a_stream_that_would_share_the_files_of_another_is_refused(tmp_path: Path, side: str) -> None:
    if side == "log":
        append_log(tmp_path / "now.sgs", {"index": 0})
    else:
        (tmp_path / "now.metrics.json").write_text('{"stream": "now.sgs"}')
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(StorageError, match="belongs to the stream now.sgs, and now would need"):
        begin_log(tmp_path / "now")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    begin_log(tmp_path / "now.sgs")


def test_a_stream_that_was_renamed_with_its_log_goes_on(tmp_path: Path) -> None:
    append_log(tmp_path / "ball.sgs", {"index": 0})
    log_path(tmp_path / "ball.sgs").rename(log_path(tmp_path / "best.sgs"))
    begin_log(tmp_path / "best.sgs", frames=1)
    assert list(read_log(tmp_path / "best.sgs")) == [0]


def test_the_log_of_a_stream_that_was_there_before_is_not_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A joined stream gets the name of a reconstructed one, and the frame 0 of both has as many bytes."""
    path = tmp_path / "a.sgs"
    begin_log(path)
    for index, size in enumerate([83, 500, 600]):
        append_log(path, {"index": index, "bytes": size})
    assert log_of(path, {0: 83, 1: 500}) == read_log(path)
    assert not caplog.messages
    assert log_of(path, {0: 83, 1: 500, 2: 601}) == {}
    sentence = f"a.log.jsonl is not used: its frames have other sizes than those of {path}, so it is of another run"
    assert caplog.messages == [f"{tmp_path}/{sentence}"]
