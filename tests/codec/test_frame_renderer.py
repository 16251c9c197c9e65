# SPDX-License-Identifier: Apache-2.0
"""A decoded scene serves every camera until another frame or another back-end is asked for."""

from dataclasses import replace

import numpy as np
import pytest

from structgstream.codec.reader import StreamReader
from structgstream.codec.sinks import MemorySink
from structgstream.kernels.backend import reference_backend
from structgstream.scene.render import render, to_8bit_image
from structgstream.scene.scene import Scene
from tests.support.streams import moved, small_scene, write_stream


def test_a_scene_is_decoded_when_frame_or_back_end_change_and_not_before(monkeypatch: pytest.MonkeyPatch) -> None:
    sink, scenes, backend = MemorySink(), [moved(small_scene(free=2), step) for step in range(2)], reference_backend()
    write_stream(sink, scenes)
    reader, decoded = StreamReader(sink.data), list[int]()
    scene = reader.scene

    def counted(index: int) -> Scene:
        decoded.append(index)
        return scene(index)

    monkeypatch.setattr(reader, "scene", counted)
    first, second, *_ = reader.header.rig
    other = replace(backend, name="cpu")
    for index, name, asked in (
        (0, first, backend),
        (0, second, backend),
        (1, second, backend),
        (1, second, other),
        (1, first, other),
    ):
        picture = reader.render(index, name, backend=asked)
        expected = to_8bit_image(render(scene(index), reader.header.camera(name), backend).image)
        assert np.array_equal(picture, expected)
    assert decoded == [0, 1, 1]
