# SPDX-License-Identifier: Apache-2.0
"""What tests of preparation share: coarse points, reports without pictures, keypoints of a picture found once a run.

Finding them takes most of the time of whatever is tested around it, and many tests look at the same pictures. A test
marked ``finds_keypoints`` finds its own.
"""

import hashlib
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.preparation.calibration import keypoints
from tests.support.quick_preparation import quicken
from tests.support.shared_folder import made_once

_FOUND: dict[str, Any] = {}
_EXTRACTOR = keypoints._extractor


class _Remembering:
    """An extractor that no process of the run lets look at a picture twice."""

    def __init__(self) -> None:
        self._extractor = _EXTRACTOR()

    def extract_from_uint8_array(self, grey: NDArray[np.uint8]) -> Any:
        key = hashlib.sha256(repr(grey.shape).encode() + grey.tobytes()).hexdigest()
        if key not in _FOUND:

            def extract(folder: Path) -> None:
                listed, stored = self._extractor.extract_from_uint8_array(grey)
                (folder / "found").write_bytes(
                    pickle.dumps((keypoints.pycolmap_module().keypoints_to_matrix(listed), stored))
                )

            matrix, stored = pickle.loads((made_once(f"keypoints-{key}", extract) / "found").read_bytes())
            _FOUND[key] = keypoints.pycolmap_module().keypoints_from_matrix(matrix), stored
        return _FOUND[key]


@pytest.fixture(autouse=True)
def keypoints_found_once(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.node.get_closest_marker("finds_keypoints") is None:
        monkeypatch.setattr(keypoints, "_extractor", _Remembering)


@pytest.fixture(autouse=True)
def quick_preparation(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "report" not in request.path.parts:
        quicken(monkeypatch)
