# SPDX-License-Identifier: Apache-2.0
"""A decoded scene serves every camera until another frame or another back-end is asked for."""

from dataclasses import replace

import numpy as np

from structgstream.codec.reader import FrameRenderer
from structgstream.kernels.backend import reference_backend
from structgstream.scene.render import render, to_8bit_image
from structgstream.scene.scene import Scene
from tests.support.rigs import arc_rig
from tests.support.streams import moved, small_scene

RIG, BACKEND = arc_rig(), reference_backend()


def test_a_scene_is_decoded_when_frame_or_back_end_change_and_not_before() -> None:
    decoded: list[int] = []

    def decode(index: int) -> Scene:
        decoded.append(index)
        return moved(small_scene(free=2), index)

    renderer, other = FrameRenderer(), replace(BACKEND, name="cpu")
    asked = [
        (0, "cam00", BACKEND),
        (0, "cam01", BACKEND),
        (1, "cam01", BACKEND),
        (1, "cam01", other),
        (1, "cam00", other),
    ]
    for index, name, backend in asked:
        picture = renderer.picture(index, RIG[name], decode=decode, backend=backend)
        assert (picture.shape, picture.dtype) == ((32, 48, 3), np.uint8)
        expected = to_8bit_image(render(moved(small_scene(free=2), index), RIG[name], BACKEND).image)
        assert np.array_equal(picture, expected)
    assert decoded == [0, 1, 1]
