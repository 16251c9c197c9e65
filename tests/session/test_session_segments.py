# SPDX-License-Identifier: Apache-2.0
"""A session writes segments as it writes a file, with a window, and goes on with them after any frame."""

from dataclasses import replace
from pathlib import Path

import pytest

from structgstream.codec.segments.sink import SegmentsOptions
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.segments.stored_bytes import read_manifest, write_archive
from structgstream.codec.sinks import resume_segments
from structgstream.kernels.backend import reference_backend
from structgstream.session.loop import Session
from structgstream.session.struct_gstream import stream_pipeline
from tests.session.test_session import capture, quick_fits, uninterrupted
from tests.support.segment_streams import Hands, folder
from tests.support.small_presets import TINY_RIG

__all__ = ["quick_fits"]

CONFIG = replace(TINY_RIG, key_interval_seconds=0.1)


def run(store: FolderStore, frames: int, options: SegmentsOptions, hands: Hands) -> list[int]:
    """What a run to ``frames`` frames adds to what is there."""
    sink, resumed = resume_segments(store, options=options, clocks=hands.clocks())
    session = Session(capture(frames), sink, stream_pipeline(CONFIG), reference_backend(), resumed=resumed)
    done = []
    for report in session.run():
        done.append(report.index)
        hands.wait(1.0)
    return done


@pytest.mark.parametrize("window_seconds", [None, 0.15])
def test_a_stream_stopped_after_any_frame_goes_on_as_if_it_had_not(
    tmp_path: Path, quick_fits: list[int], window_seconds: float | None
) -> None:
    options = SegmentsOptions(window_seconds=window_seconds, grace_seconds=0.0)
    whole = folder(tmp_path / "whole")
    assert run(whole, 12, options, Hands()) == [*range(12)]
    files = {entry.file for entry in read_manifest(whole).segments}
    for stop in range(1, 13):
        store, hands = folder(tmp_path / f"{stop}"), Hands()
        assert run(store, stop, options, hands) == [*range(stop)]
        assert run(store, 12, options, hands) == [*range(stop, 12)]
        assert {entry.file for entry in read_manifest(store).segments} == files
        assert read_manifest(store).window == read_manifest(whole).window
    if window_seconds is None:
        write_archive(whole, tmp_path / "a.sgs")
        assert (tmp_path / "a.sgs").read_bytes() == uninterrupted(12, CONFIG)
