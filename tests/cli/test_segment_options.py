# SPDX-License-Identifier: Apache-2.0
"""Options of a stream that is written as segments."""

import math
from pathlib import Path

import pytest

from structgstream.cli.app import UsageError
from structgstream.cli.options import SegmentOptions
from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.quality_list import ListedQuality, write_list
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.segments.stored_bytes import read_manifest
from structgstream.errors import StorageError
from tests.support.segment_streams import header, packets


def test_what_is_there_says_how_it_is_written(tmp_path: Path) -> None:
    assert SegmentOptions().chosen(tmp_path / "new.sgs") == "file"
    (tmp_path / "studio").mkdir()
    assert SegmentOptions().chosen(tmp_path / "studio") == "file"
    (tmp_path / "studio" / MANIFEST).touch()
    assert SegmentOptions().chosen(tmp_path / "studio") == "segments"
    assert SegmentOptions(sink="file").chosen(tmp_path / "studio") == "file"
    assert SegmentOptions(sink="segments").chosen(tmp_path / "new") == "segments"


def test_options_of_segments_are_not_for_a_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--window is for --sink segments"):
        SegmentOptions(window=5.0).chosen(tmp_path / "x.sgs")
    with pytest.raises(UsageError, match="--publish is for --sink segments"):
        SegmentOptions(publish="s3://x/y").chosen(tmp_path / "x.sgs")
    assert SegmentOptions(sink="segments", window=5.0, publish="s3://x/y").chosen(tmp_path / "x") == "segments"


@pytest.mark.parametrize(
    ("window", "keep"), [(0.0, 1.0), (-1.0, 1.0), (math.nan, 1.0), (math.inf, 1.0), (1.0, -1.0), (1.0, math.nan)]
)
def test_seconds_that_make_no_sense(tmp_path: Path, window: float, keep: float) -> None:
    with pytest.raises(UsageError, match="--window must be a positive number of seconds, and --keep zero or more"):
        SegmentOptions(sink="segments", window=window, keep=keep).chosen(tmp_path / "x")


def test_seconds_that_do(tmp_path: Path) -> None:
    for window, keep in ((0.1, 0.0), (1e6, math.inf)):
        assert SegmentOptions(sink="segments", window=window, keep=keep).chosen(tmp_path / "x") == "segments"


def test_a_file_is_checked_and_left_to_others(tmp_path: Path) -> None:
    with SegmentOptions().storage(tmp_path / "new.sgs", may_exist=False, report=print) as storage:
        assert storage is None
    (tmp_path / "old.sgs").touch()
    with (
        pytest.raises(StorageError, match="old.sgs exists"),
        SegmentOptions().storage(tmp_path / "old.sgs", may_exist=False, report=print),
    ):
        pass


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_the_manifest_says_when_a_live_frame_was_filmed(tmp_path: Path) -> None:
    options = SegmentOptions(sink="segments")
    with options.storage(tmp_path / "now", may_exist=False, report=print) as storage:
        assert storage is not None
        sink, resumed = storage(lambda frame: 1.7e9 + frame)(False)
        assert resumed is None
        sink.open(header())
        for packet in packets(2):
            sink.write(packet)
        assert read_manifest(FolderStore(tmp_path / "now")).edge.captured_unix_seconds == 1.7e9 + 1
        sink.close()


def test_window_and_grace_arrive(tmp_path: Path) -> None:
    options = SegmentOptions(sink="segments", window=0.05, keep=0.0)
    with options.storage(tmp_path / "now", may_exist=False, report=print) as storage:
        assert storage is not None
        sink, _ = storage(None)(False)
        sink.open(header())
        for packet in packets(12):
            sink.write(packet)
        sink.close()
    manifest = read_manifest(FolderStore(tmp_path / "now"))
    assert (manifest.window.seconds, manifest.edge.captured_unix_seconds) == (0.05, None)
    assert manifest.window.first_frame > 0
    assert not (tmp_path / "now" / manifest.segments[1].file).exists()


def test_a_folder_that_is_there_is_asked_for(tmp_path: Path) -> None:
    options, output = SegmentOptions(sink="segments"), tmp_path / "now"
    with options.storage(output, may_exist=False, report=print) as storage:
        assert storage is not None
        sink, _ = storage(None)(False)
        sink.open(header())
        sink.write(packets(1)[0])
        sink.close()
    with pytest.raises(StorageError, match="--resume"), options.storage(output, may_exist=False, report=print):
        pass
    with options.storage(output, may_exist=True, report=print) as storage:
        assert storage is not None


def test_each_quality_has_a_folder_of_its_own(tmp_path: Path) -> None:
    options, out = SegmentOptions(sink="segments"), tmp_path / "out"
    found = options.quality_folders(out, ["low", "high"], resume=False, overwrite=False)
    assert [*found] == ["low", "high"]
    assert all((out / name).is_dir() for name in found)
    write_list(out, [ListedQuality(name, f"{name}/{MANIFEST}", 1e6) for name in ("low", "high")])
    assert SegmentOptions().quality_folders(out, ["high", "low"], resume=True, overwrite=False)
    with pytest.raises(UsageError, match="holds the qualities low, high, got low, mid; give the same names"):
        options.quality_folders(out, ["low", "mid"], resume=True, overwrite=False)
    with pytest.raises(UsageError, match="holds several qualities of one stream; continue them with --qualities"):
        options.chosen(out)
