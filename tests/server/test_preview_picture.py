# SPDX-License-Identifier: Apache-2.0
"""The program that renders a preview."""

import io
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pictures import decoded_picture
from segment_folders import GrowingFolder
from streams import splat_stream
from structgstream.codec.container.records import PREFIX, read_record
from structgstream.codec.reader import StreamReader
from structgstream.codec.segments.manifest import MANIFEST, Manifest, Window
from structgstream.codec.segments.manifest_json import manifest_to_json
from structgstream.errors import StreamError
from structgstream.server import preview_picture
from structgstream.server.catalog import Catalog, ServedStream
from structgstream.server.preview_picture import main, picture, preview


@pytest.fixture(scope="module")
def stream() -> bytes:
    return splat_stream()


def test_the_picture_is_of_the_middle_key_frame_of_a_finished_file(tmp_path: Path, stream: bytes) -> None:
    (tmp_path / "ball.sgs").write_bytes(stream)
    found = decoded_picture(preview(Catalog(tmp_path).found["ball.sgs"]))
    with StreamReader(stream) as reader:
        name = reader.header.rig.training[len(reader.header.rig.training) // 2]
        assert np.array_equal(found, reader.render(3, name))


def test_the_picture_is_of_the_first_frame_of_a_growing_file(tmp_path: Path, stream: bytes) -> None:
    (tmp_path / "ball.sgs").write_bytes(stream[:-1])
    found = decoded_picture(preview(Catalog(tmp_path).found["ball.sgs"]))
    with StreamReader(stream) as reader:
        name = reader.header.rig.training[len(reader.header.rig.training) // 2]
        assert np.array_equal(found, reader.render(0, name))


def test_the_picture_is_of_the_newest_key_frame_of_segments(tmp_path: Path, stream: bytes) -> None:
    growing = GrowingFolder(tmp_path / "studio", stream)
    with StreamReader(stream) as reader:
        name = reader.header.rig.training[len(reader.header.rig.training) // 2]
        for key in (0, 0, 0, 3, 3, 3, 6):
            growing.write()
            found = decoded_picture(preview(Catalog(tmp_path).found["studio"]))
            assert np.array_equal(found, reader.render(key, name))
        growing.finish()
        found = decoded_picture(preview(Catalog(tmp_path).found["studio"]))
        assert np.array_equal(found, reader.render(6, name))


def init_bytes(stream: bytes) -> int:
    init = read_record(stream, PREFIX.size)
    assert init is not None
    return init.end


def test_what_has_no_whole_key_packet_has_no_picture(stream: bytes) -> None:
    end = init_bytes(stream)
    with StreamReader(stream) as reader:
        assert picture(stream[:end], stream[end:]).shape[2] == 3
        delta = reader.packets.offsets[1]
    for key in (b"", stream[end : end + 20], stream[delta:], stream[PREFIX.size :]):
        with pytest.raises(StreamError, match="no whole key packet"):
            picture(stream[:end], key)
    with pytest.raises(StreamError, match="no whole key packet"):
        picture(stream[: PREFIX.size], stream[end:])
    with pytest.raises(StreamError):
        picture(stream[end:], stream[end:])


def test_a_large_picture_is_made_small_in_its_proportions(stream: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    end = init_bytes(stream)
    height, width, _ = picture(stream[:end], stream[end:]).shape
    monkeypatch.setattr(preview_picture, "WIDTH", width // 2)
    assert picture(stream[:end], stream[end:]).shape == (round(height * (width // 2) / width), width // 2, 3)


def test_a_file_without_its_init_record_has_no_picture(tmp_path: Path, stream: bytes) -> None:
    (tmp_path / "cut.sgs").write_bytes(stream[: init_bytes(stream) - 1])
    (tmp_path / "other.sgs").write_bytes(b"not a stream at all")
    for one in Catalog(tmp_path).found.values():
        with pytest.raises(StreamError):
            preview(one)


def studio(folder: Path, stream: bytes, *, frames: int) -> tuple[ServedStream, Manifest]:
    """A folder of segments with so many frames."""
    growing = GrowingFolder(folder / "studio", stream)
    for _ in range(frames):
        growing.write()
    assert growing.manifest is not None
    return Catalog(folder).found["studio"], growing.manifest


def test_what_has_left_the_window_has_no_picture(tmp_path: Path, stream: bytes) -> None:
    one, manifest = studio(tmp_path, stream, frames=3)
    whole = GrowingFolder(tmp_path / "whole", stream)
    last = whole.write_all()
    assert manifest.parts
    gone = replace(last, window=Window(6, 3, 1.0), periods=(replace(last.periods[0], period=5, first_frame=6),))
    (tmp_path / "studio" / MANIFEST).write_bytes(manifest_to_json(gone))
    with pytest.raises(StreamError, match="studio has no key packet in its window"):
        preview(one)


def test_a_file_that_is_missing_or_large_is_not_read(
    tmp_path: Path, stream: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, manifest = studio(tmp_path, stream, frames=2)
    monkeypatch.setattr(preview_picture, "MOST_BYTES", manifest.periods[0].bytes - 1)
    with pytest.raises(StreamError, match=f"studio has no .*{MANIFEST}|too large for a preview"):
        preview(one)
    monkeypatch.undo()
    (tmp_path / "studio" / manifest.parts[0].file).unlink()
    with pytest.raises(StreamError, match=f"studio has no {manifest.parts[0].file}"):
        preview(one)


class Output:
    """A standard output that keeps bytes."""

    def __init__(self) -> None:
        self.buffer = io.BytesIO()


def test_the_program(
    tmp_path: Path, stream: bytes, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "ball.sgs").write_bytes(stream)
    (tmp_path / "bad.sgs").write_bytes(stream[:50])
    nice: list[int] = []
    monkeypatch.setattr(os, "nice", nice.append)
    assert main([str(tmp_path), "bad.sgs", "file"]) == 1
    assert "bad.sgs" in capsys.readouterr().err
    output = Output()
    monkeypatch.setattr(sys, "stdout", output)
    assert main([str(tmp_path), "ball.sgs", "file"]) == 0
    found = decoded_picture(output.buffer.getvalue())
    assert np.array_equal(found, decoded_picture(preview(Catalog(tmp_path).found["ball.sgs"])))
    assert nice == [10, 10]
