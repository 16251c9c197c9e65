# SPDX-License-Identifier: Apache-2.0
import math

from structgstream.evaluation.run_log import log_entry
from structgstream.qualities import joint_entry, joint_report
from tests.support.reports import frame_report


def test_bytes_and_seconds_are_sums() -> None:
    low = frame_report(3, bytes=100, seconds={"read": 1.0, "fit": 2.0, "total": 3.0}, absent=("b",), cpu_seconds=2.0)
    high = frame_report(3, bytes=400, seconds={"fit": 4.0, "total": 5.0}, absent=("b",), cpu_seconds=4.0)
    joint = joint_report({"low": low, "high": high})
    assert (joint.index, joint.bytes, joint.cpu_seconds, joint.absent) == (3, 500, 6.0, ("b",))
    assert joint.seconds == {"read": 1.0, "fit": 6.0, "total": 8.0}
    assert math.isnan(joint.train_psnr)
    entry = joint_entry(joint, {"low": log_entry(low), "high": log_entry(high)})
    assert (entry["index"], entry["bytes"], entry["total_seconds"], entry["absent"]) == (3, 500, 8.0, ["b"])
    assert entry["qualities"]["low"] == {
        "kind": "delta",
        "bytes": 100,
        "train_psnr": 20.0,
        "total_seconds": 3.0,
        "cpu_seconds": 2.0,
        "anchors": 1,
        "free": 0,
    }
