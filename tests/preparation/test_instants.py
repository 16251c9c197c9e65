# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from structgstream.data.timeline import Clock
from structgstream.errors import CaptureError
from structgstream.preparation.footage import find_footage, shared_seconds, shots_of, spread_moments
from tests.support.captures import numbers, write_videos


def test_pictures_of_one_moment_by_the_clocks(tmp_path: Path) -> None:
    write_videos(tmp_path, ["a", "b"], frames=10)
    footage = find_footage(tmp_path)
    clocks = {"b": Clock(-3 / 30)}
    first, last = shared_seconds(footage, clocks)
    assert (first, last) == pytest.approx((0.0, 6 / 30))
    shots = shots_of(footage, clocks, spread_moments(first, last, 3))
    assert [numbers(image)[1] for image in shots["a"]] == [0, 3, 6]
    assert [numbers(image)[1] for image in shots["b"]] == [3, 6, 9]
    assert numbers(shots["b"][1])[1] == 6
    assert len(shots["b"][1:]) == 2


def test_videos_shorter_than_the_offset_are_reported(tmp_path: Path) -> None:
    write_videos(tmp_path, ["a", "b"], frames=10)
    footage = find_footage(tmp_path)
    with pytest.raises(
        CaptureError, match=r"a\.mp4 of camera 'a' ends .* before b\.mp4 of camera 'b' begins.*--without"
    ):
        shared_seconds(footage, {"b": Clock(2.0)})
