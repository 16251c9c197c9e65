# SPDX-License-Identifier: Apache-2.0
"""Pictures as files, read back by tests."""

import cv2
import numpy as np
from numpy.typing import NDArray


def decoded_picture(data: bytes) -> NDArray[np.uint8]:
    """The picture ``[H, W, 3]`` of an encoded file, sRGB."""
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None, "no picture"
    return np.asarray(picture[..., ::-1], dtype=np.uint8)
