# SPDX-License-Identifier: Apache-2.0
from benchmarks.report import growth_lines, milliseconds, variant_lines

SECONDS = {"median": 0.002, "least": 0.001, "most": 0.003}
ROOFLINE = {"operations": 8e8, "bytes": 4e7, "operations_per_second": 4e11, "share_of_roof": 0.5}


def entry(**changes: object) -> dict[str, object]:
    plain = {"seconds": SECONDS, "times_faster": None, "facts": {}, "per_second": None, "roofline": None}
    return plain | changes


def test_a_contest_is_a_table_with_ratios_facts_and_the_roof() -> None:
    benchmark = {"name": "thing", "work": "doing it", "per_second": "things a second"}
    fast = entry(
        times_faster={"median": 4.0, "least": 3.5, "most": 5.0},
        facts={"held-out psnr": 31.234, "raster_seconds": 0.001, "raster_share": 0.5, "idle_share": 0.0},
        per_second=500.0,
        roofline=ROOFLINE,
    )
    target = {"contestant": "fast", "at_least_times": 5.0, "got": 4.0, "met": False}
    variant = {
        "title": "small",
        "contestants": {"slow": entry(), "fast": fast},
        "targets": [target],
        "others_share": 0.124,
    }
    lines = list(variant_lines(benchmark, variant))
    assert lines[0] == "**thing**: doing it; small"
    assert "| slow | 2.00 ms | 1.00 ms to 3.00 ms | 1 |  |" in lines
    assert (
        "| fast | 2.00 ms | 1.00 ms to 3.00 ms | 4.0 (3.5 to 5.0) | 500.0 things a second; held-out psnr 31.23 dB; "
        "raster 1.00 ms (50 %); 400 GFLOP/s; 50 % of the roof at 20 operations a byte |"
    ) in lines
    assert "Target of fast: at least 5 times; got 4.0 times: missed." in lines
    assert "Meanwhile other processes took 12 % of the machine." in lines


def test_growth_is_a_table_with_slopes_and_quality() -> None:
    points = [
        {"size": size, "seconds": {**SECONDS, "median": seconds}, "facts": {"held-out psnr": 30.0 + seconds}}
        for size, seconds in ((1000, 0.5), (2000, 1.0))
    ]
    growth = {"axis": "anchors", "curves": {"ours": points}, "slopes": {"ours": 1.0}, "others_share": 0.5}
    lines = list(growth_lines({"name": "thing"}, growth))
    assert "| contestant | 1,000 | 2,000 | slope |" in lines
    assert "| ours | 500 ms | 1000 ms | 1.00 |" in lines
    assert "| ours: held-out psnr, dB | 30.50 | 31.00 | |" in lines
    assert "Meanwhile other processes took 50 % of the machine." in lines


def test_digits_follow_the_size() -> None:
    assert [milliseconds(x) for x in (0.00123, 0.0123, 0.123, 12.3)] == ["1.23 ms", "12.3 ms", "123 ms", "12.3 s"]
