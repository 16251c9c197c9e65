# SPDX-License-Identifier: Apache-2.0
import json

from structgstream.preparation.checking.check import CameraCheck, CheckReport, Coverage, Finding, PairCheck


def report(*errors: float | None) -> CheckReport:
    pairs = tuple(
        PairCheck("cam0", f"cam{number}", 0 if error is None else 40, error, None if error is None else 0.1)
        for number, error in enumerate(errors, 1)
    )
    return CheckReport(
        capture="take",
        frame=0,
        cameras={"cam0": CameraCheck(0.5, 0.9, 12, 2), "cam1": CameraCheck(None, None, 0, 0)},
        pairs=pairs,
        coverage=Coverage(12, 0.5, 3.0),
        findings=(Finding("error", "Broken.", ("cam0",)), Finding("warning", "Odd.")),
        rig_radius=1.0,
        near=0.1,
        nearest=None,
    )


def test_the_median_is_of_pairs_with_matches() -> None:
    assert report(None, 5.0, 0.2, 0.4).median_epipolar_pixels == 0.4
    assert report(None, None).median_epipolar_pixels is None


def test_a_report_is_plain_json() -> None:
    found = json.loads(json.dumps(report(None, 0.3).as_json()))
    assert found["median_epipolar_pixels"] == 0.3
    assert found["pairs"][0] == {
        "first": "cam0", "second": "cam1", "matches": 0, "epipolar_pixels": None, "share_violating": None,
    }  # fmt: skip
    assert found["cameras"]["cam0"]["overlaps"] == 2
    assert found["findings"][0] == {"severity": "error", "sentence": "Broken.", "cameras": ["cam0"]}
