# SPDX-License-Identifier: Apache-2.0
"""PNG files read back by OpenCV."""

import cv2
import numpy as np
import pytest

from structgstream.evaluation.pictures import png_bytes


@pytest.mark.parametrize("shape", [(1, 1, 3), (5, 3, 3), (64, 97, 3)])
def test_a_decoder_gives_the_same_pixels(shape: tuple[int, int, int]) -> None:
    picture = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    decoded = cv2.imdecode(np.frombuffer(png_bytes(picture), np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded is not None
    np.testing.assert_array_equal(decoded[..., ::-1], picture)
