# SPDX-License-Identifier: Apache-2.0
"""What live cameras do at a moment, as values."""

from types import SimpleNamespace
from typing import Any

from structgstream.data.live.outlets import QueueStatus
from structgstream.data.live.status import CameraStatus, LiveStatus, SetAges

AGES = SetAges(0.25, 0.5, 0.75)
FAULTS = {"a": {"stuck": 2}}
ARRIVALS: Any = SimpleNamespace(
    present=["a"],
    lengths={"a": 3, "b": 0},
    feeds={"a": SimpleNamespace(decoded=10), "b": SimpleNamespace(decoded=4)},
    sets=7,
    small=1,
)


def status(arrivals: Any, queue: QueueStatus | None) -> LiveStatus:
    return LiveStatus.of(arrivals, queue, faults=FAULTS, cameras=("a", "b"), handed_per_second=2.5, ages=AGES)


def test_before_cameras_are_opened_only_their_faults_are_known() -> None:
    expected = LiveStatus({"a": CameraStatus(faults={"stuck": 2}), "b": CameraStatus()})
    assert status(None, None) == status(ARRIVALS, None) == status(None, QueueStatus(1, 2, 3)) == expected
    assert (expected.sets, expected.delay_seconds) == (0, None)


def test_every_number_stands_under_its_name() -> None:
    assert status(ARRIVALS, QueueStatus(waiting=5, waiting_bytes=900, skipped=6)) == LiveStatus(
        cameras={"a": CameraStatus(True, 10, 3, {"stuck": 2}), "b": CameraStatus(False, 4, 0, {})},
        sets=7,
        small_sets=1,
        skipped_sets=6,
        waiting_sets=5,
        waiting_bytes=900,
        handed_per_second=2.5,
        arrived_seconds=0.25,
        matched_seconds=0.5,
        delay_seconds=0.75,
    )
