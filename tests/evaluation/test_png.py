# SPDX-License-Identifier: Apache-2.0
"""PNG files read back by OpenCV."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from structgstream.errors import StorageError
from structgstream.evaluation.pictures import png_bytes, write_png


@pytest.mark.parametrize("shape", [(1, 1, 3), (5, 3, 3), (64, 97, 3)])
def test_a_decoder_gives_the_same_pixels(shape: tuple[int, int, int]) -> None:
    picture = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    decoded = cv2.imdecode(np.frombuffer(png_bytes(picture), np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded is not None
    np.testing.assert_array_equal(decoded[..., ::-1], picture)


def test_a_folder_is_made_and_a_blocked_one_is_said(tmp_path: Path) -> None:
    write_png(tmp_path / "a" / "b.png", np.zeros((2, 2, 3), np.uint8))
    assert (tmp_path / "a" / "b.png").stat().st_size > 0
    with pytest.raises(StorageError, match="cannot be written"):
        write_png(tmp_path / "a" / "b.png" / "c.png", np.zeros((2, 2, 3), np.uint8))
