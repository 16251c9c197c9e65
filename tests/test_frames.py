# SPDX-License-Identifier: Apache-2.0
import numpy as np

from structgstream.frames import MultiViewFrame


def test_its_text_tells_shapes_and_not_pixels() -> None:
    images = {name: np.zeros((4, 6, 3), dtype=np.uint8) for name in ("a", "b")}
    assert repr(MultiViewFrame(3, 0.1, images)) == "MultiViewFrame(index=3, pts_seconds=0.1000, 2 x [(4, 6, 3)])"
