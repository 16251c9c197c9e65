# SPDX-License-Identifier: Apache-2.0
"""Options of a stream that is written as segments; what they refuse is in ``test_segments`` and ``test_quality_run``,
too."""

import math
from pathlib import Path

import pytest

from structgstream.cli.app import UsageError
from structgstream.cli.options import SegmentOptions
from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.sink import Clocks
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.segments.stored_bytes import read_manifest
from tests.support.segment_streams import header, packets


def test_what_is_there_says_how_it_is_written(tmp_path: Path) -> None:
    assert SegmentOptions().chosen(tmp_path / "new.sgs") == "file"
    (tmp_path / "studio").mkdir()
    assert SegmentOptions().chosen(tmp_path / "studio") == "file"
    (tmp_path / "studio" / MANIFEST).touch()
    assert SegmentOptions().chosen(tmp_path / "studio") == "segments"
    assert SegmentOptions(sink="file").chosen(tmp_path / "studio") == "file"
    for window, keep in ((0.1, 0.0), (1e6, math.inf)):
        assert SegmentOptions(sink="segments", window=window, keep=keep).chosen(tmp_path / "x") == "segments"


@pytest.mark.parametrize(
    ("window", "keep"), [(0.0, 1.0), (-1.0, 1.0), (math.nan, 1.0), (math.inf, 1.0), (1.0, -1.0), (1.0, math.nan)]
)
def test_seconds_that_make_no_sense(tmp_path: Path, window: float, keep: float) -> None:
    with pytest.raises(UsageError, match="--window must be a positive number of seconds, and --keep zero or more"):
        SegmentOptions(sink="segments", window=window, keep=keep).chosen(tmp_path / "x")


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
@pytest.mark.parametrize(
    ("clocks", "captured"), [(None, None), (Clocks(captured=lambda frame: 1.7e9 + frame), 1.7e9 + 11)]
)
def test_window_grace_and_when_a_live_frame_was_filmed_arrive(
    tmp_path: Path, clocks: Clocks | None, captured: float | None
) -> None:
    options = SegmentOptions(sink="segments", window=0.05, keep=0.0)
    with options.storage(tmp_path / "now", may_exist=False, report=print, clocks=clocks) as storage:
        assert storage is not None
        sink, resumed = storage(False)
        assert resumed is None
        sink.open(header())
        for packet in packets(12):
            sink.write(packet)
        sink.close()
    manifest = read_manifest(FolderStore(tmp_path / "now"))
    assert (manifest.window.seconds, manifest.edge.captured_unix_seconds) == (0.05, captured)
    assert manifest.window.first_frame > 0
    assert not (tmp_path / "now" / manifest.segments[1].file).exists()
