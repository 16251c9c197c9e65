# SPDX-License-Identifier: Apache-2.0
"""What tests of preparation share: keypoints of a picture are found once a process.

Finding them takes most of the time of whatever is tested around it, and many tests look at the same pictures. A test
marked ``finds_keypoints`` finds its own.
"""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.preparation.calibration import keypoints

_FOUND: dict[tuple[keypoints.KeypointConfig, tuple[int, ...], bytes], Any] = {}
_EXTRACTOR = keypoints._extractor


class _Remembering:
    """An extractor that looks at no picture twice."""

    def __init__(self, config: keypoints.KeypointConfig) -> None:
        self._config, self._extractor = config, _EXTRACTOR(config)

    def extract_from_uint8_array(self, grey: NDArray[np.uint8]) -> Any:
        key = (self._config, grey.shape, grey.tobytes())
        if key not in _FOUND:
            _FOUND[key] = self._extractor.extract_from_uint8_array(grey)
        return _FOUND[key]


@pytest.fixture(autouse=True)
def keypoints_found_once(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.node.get_closest_marker("finds_keypoints") is None:
        monkeypatch.setattr(keypoints, "_extractor", _Remembering)
