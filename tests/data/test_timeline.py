# SPDX-License-Identifier: Apache-2.0
import logging

import pytest

from structgstream.data.timeline import common_slots, natural
from structgstream.errors import CaptureError


def common(**slots: list[int]) -> range:
    return common_slots(slots, where="take", label=lambda slot: f"frame {slot}")


def test_numbers_sort_by_value() -> None:
    assert sorted(["cam10", "cam2", "a", "30", "4"], key=natural) == ["4", "30", "a", "cam2", "cam10"]


def test_a_late_start_and_an_early_end_cut_the_range_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert common(a=[0, 1, 2, 3], b=[1, 2, 3, 4, 5]) == range(1, 4)
    first, second = (record.getMessage() for record in caplog.records)
    assert "'b' starts with frame 1; 1 earlier" in first
    assert "'a' ends with frame 3; 2 later" in second


def test_equal_cameras_warn_of_nothing(caplog: pytest.LogCaptureFixture) -> None:
    assert common(a=[4, 5], b=[4, 5]) == range(4, 6)
    assert not caplog.records


@pytest.mark.parametrize(
    ("b", "words"),
    [
        ([0, 1, 3], "'b' of take has no frame for frame 2"),
        ([0, 1, 1, 2, 3], "'b' of take has two frames for frame 1"),
        ([7, 8], "no frames in common: 'a' ends with frame 3 and 'b' starts with frame 7"),
        ([], "'b' of take has no frames"),
    ],
)
def test_a_broken_timeline_names_camera_and_instant(b: list[int], words: str) -> None:
    with pytest.raises(CaptureError, match=words):
        common(a=[0, 1, 2, 3], b=b)
