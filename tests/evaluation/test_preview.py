# SPDX-License-Identifier: Apache-2.0
"""The preview picture of a stream of segments."""

from pathlib import Path

import numpy as np
import pytest

from structgstream import recorder as module
from structgstream.codec.reader import StreamReader, open_stream
from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.mirror import MirroredStore
from structgstream.codec.segments.sink import SegmentsSink
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.sinks import MemorySink
from structgstream.errors import StorageError
from structgstream.recorder import PREVIEW, PreviewSink, preview
from tests.support.pictures import decoded_picture
from tests.support.rigs import random_scene
from tests.support.streams import compact_header, moved, write_stream

SCENES = [moved(random_scene(60, seed=4), step) for step in range(5)]  # a key packet at every third frame


def middle_camera(reader: StreamReader) -> str:
    return reader.header.rig.training[len(reader.header.rig.training) // 2]


def test_the_picture_is_of_the_newest_key_frame(tmp_path: Path) -> None:
    store, plain = FolderStore(tmp_path / "studio"), FolderStore(tmp_path / "plain")
    for each in (store, plain):
        each.prepare()
    header = compact_header(SCENES[0])
    write_stream(PreviewSink(SegmentsSink(store), store), SCENES, header=header)
    write_stream(SegmentsSink(plain), SCENES, header=header)
    reader = open_stream(store.folder)
    found = decoded_picture((store.folder / PREVIEW).read_bytes())
    assert np.array_equal(found, reader.render(3, middle_camera(reader)))
    assert store.names() == plain.names(), "the stream itself is the same"


def test_a_large_picture_is_made_small_in_its_proportions(monkeypatch: pytest.MonkeyPatch) -> None:
    sink = MemorySink()
    header = compact_header(SCENES[0])
    write_stream(sink, SCENES[:1], header=header)
    with StreamReader(sink.data) as reader:
        (packet,) = reader.group(0)
        camera = header.rig[middle_camera(reader)]
    monkeypatch.setattr(module, "PREVIEW_WIDTH", camera.width // 2)
    width = camera.width // 2
    assert preview(header, packet).shape == (round(camera.height * width / camera.width), width, 3)


def test_a_disk_that_is_full_loses_the_picture_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = FolderStore(tmp_path)
    store.prepare()
    put = FolderStore.put

    def failing(self: FolderStore, name: str, data: bytes) -> None:
        if name == PREVIEW:
            raise StorageError("No space left on device.")
        put(self, name, data)

    monkeypatch.setattr(FolderStore, "put", failing)
    write_stream(PreviewSink(SegmentsSink(store), store), SCENES, header=compact_header(SCENES[0]))
    assert len(open_stream(tmp_path)) == len(SCENES)
    assert not (tmp_path / PREVIEW).exists()


def test_a_published_copy_has_no_picture(tmp_path: Path) -> None:
    folder, remote = FolderStore(tmp_path / "studio"), FolderStore(tmp_path / "remote")
    for each in (folder, remote):
        each.prepare()
    mirror = MirroredStore(folder, remote)
    mirror.claim()
    write_stream(PreviewSink(SegmentsSink(mirror), mirror), SCENES, header=compact_header(SCENES[0]))
    assert mirror.finish(wait_seconds=60.0) == 0
    assert (tmp_path / "studio" / PREVIEW).exists()
    assert (tmp_path / "remote" / MANIFEST).exists()
    assert not (tmp_path / "remote" / PREVIEW).exists()
