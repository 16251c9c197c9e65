# SPDX-License-Identifier: Apache-2.0
"""Sessions of sources whose length nobody knows: asked when the trainer is free, ended, resumed exactly."""

import shutil
from pathlib import Path

import pytest

from structgstream.codec.reader import open_stream
from structgstream.codec.sinks import FileSink
from structgstream.data.live.resume_cache import resume_folder
from structgstream.recorder import record
from structgstream.session.loop import Session
from structgstream.session.presets import StreamConfig
from structgstream.session.struct_gstream import stream_pipeline
from tests.support.backends import quickest_backend
from tests.support.moving_block import PERIODS, LiveBlock
from tests.support.small_presets import QUICK


def test_the_newest_frame_is_asked_for_when_the_one_before_is_stored(tmp_path: Path) -> None:
    source = LiveBlock(tmp_path / "x.sgs", 4)
    pipeline = stream_pipeline(QUICK)
    sink = FileSink(tmp_path / "x.sgs")
    for report in Session(source, sink, pipeline, quickest_backend()).run():
        source.instant = report.index + 1
    assert source.filmed == {0: 0, 1: 1, 2: 2, 3: 3}
    with open_stream(tmp_path / "x.sgs") as reader:
        assert reader.complete
        assert [info.pts_seconds for info in reader.packets] == [0.0, 0.25, 0.5, 0.75]


@pytest.mark.parametrize(("config", "killed_after"), [(QUICK, (1, 3)), (PERIODS, (3, 4, 5))], ids=["one", "periods"])
def test_a_live_stream_that_was_killed_goes_on_to_the_same_bytes(
    tmp_path: Path, killed_after: tuple[int, ...], config: StreamConfig
) -> None:
    pipeline, backend = stream_pipeline(config), quickest_backend()
    assert pipeline.method.needs_before, "otherwise no picture is needed again"
    whole = tmp_path / "whole.sgs"
    for report in record(whole, LiveBlock(whole, 6), pipeline, backend).reports:
        # What a kill -9 leaves: no index, and the frames that a resumed run needs.
        left = tmp_path / f"{report.index + 1}.sgs"
        shutil.copy(whole, left)
        shutil.copytree(resume_folder(whole), resume_folder(left))
    with open_stream(whole) as reader:
        assert [period.first_frame for period in reader.periods] == [0, 3][: 1 + config.period.enabled]
    for frames in killed_after:
        path = tmp_path / f"{frames}.sgs"
        again = record(path, LiveBlock(path, 6, resume=True), pipeline, backend, resume=True)
        assert again.done == frames
        assert [report.index for report in again.reports] == list(range(frames, 6))
        assert path.read_bytes() == whole.read_bytes()


def test_a_finished_live_stream_can_go_on(tmp_path: Path) -> None:
    pipeline, backend, path = stream_pipeline(QUICK), quickest_backend(), tmp_path / "x.sgs"
    list(record(path, LiveBlock(path, 2), pipeline, backend).reports)
    again = record(path, LiveBlock(path, 4, resume=True), pipeline, backend, resume=True)
    assert [report.index for report in again.reports] == [2, 3]
    with open_stream(path) as reader:
        assert reader.complete
        assert len(reader) == 4
