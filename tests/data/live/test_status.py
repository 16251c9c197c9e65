# SPDX-License-Identifier: Apache-2.0

import pytest

from structgstream.data.live.status import Fault, FaultLog


def test_each_kind_of_each_camera_is_logged_once_a_minute_and_always_counted(caplog: pytest.LogCaptureFixture) -> None:
    now = [0.0]
    faults = FaultLog("studio", now=lambda: now[0])
    for _ in range(100):
        faults.report("a", Fault.GARBAGE, "sends garbage")
    faults.report("b", Fault.GARBAGE, "sends garbage")
    faults.report("a", Fault.STUCK, "stands still")
    now[0] = 61.0
    faults.report("a", Fault.GARBAGE, "sends garbage")
    faults.count("a", Fault.OVERFLOW)
    assert [record.getMessage() for record in caplog.records] == [
        "studio: camera 'a' sends garbage",
        "studio: camera 'b' sends garbage",
        "studio: camera 'a' stands still",
        "studio: camera 'a' sends garbage",
    ]
    assert faults.counts == {"a": {"garbage": 101, "stuck": 1, "overflow": 1}, "b": {"garbage": 1}}
