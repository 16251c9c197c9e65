# SPDX-License-Identifier: Apache-2.0
"""The picture of a stream's bytes: fields in colours, key packets that tower, long streams."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from structgstream.evaluation.byte_count import REST, Parts, Row, field_colors, groups_of, write_byte_plot
from structgstream.figure import COLORS, OTHER
from tests.support.drawn import coloured, pixels_of

HEADER = {"anchor_features": 6e5, "anchor_positions": 3e5, REST: 4e3}


def packets(count: int, *, key_times: float = 2.0) -> list[Row]:
    """Mostly positions, then free Gaussians; every fifth a key packet."""
    rows = []
    for i in range(count):
        size = round(10_000 * (key_times if i % 5 == 0 else 1.0))
        sizes = {"anchor_positions": size, "free": size // 2, "free_births": 20, REST: 24}
        rows.append(Row(i, "delta" if i % 5 else "key", i / 30, 0, sum(sizes.values()), sizes, first=i == 0))
    return rows


def parts(rows: list[Row]) -> Parts:
    return {"header": HEADER, **groups_of(rows)}


def test_colours_go_to_the_largest_fields_of_the_delta_packets_first() -> None:
    assert field_colors(parts(packets(6))) == {
        "anchor_positions": COLORS[0],
        "free": COLORS[1],
        "anchor_features": COLORS[2],
        REST: OTHER,
    }
    many = {"header": {f"field {i}": 1.0 for i in range(20)}}
    assert len(field_colors(many)) == len(COLORS) + 1


def test_every_field_is_seen_in_both_panels(tmp_path: Path) -> None:
    rows = packets(12)
    write_byte_plot(tmp_path / "new" / "bytes.png", rows, parts(rows), title="ball")
    picture = pixels_of(tmp_path / "new" / "bytes.png")
    bars, shares = np.split(picture[:, : int(0.8 * picture.shape[1])], [int(0.7 * picture.shape[0])])
    for panel in (bars, shares):
        first, second = coloured(panel, COLORS[0]), coloured(panel, COLORS[1])
        assert first > second > 1000
    assert coloured(bars, COLORS[0]) == pytest.approx(2 * coloured(bars, COLORS[1]), rel=0.05)
    assert coloured(shares, COLORS[2]) > 1000 > coloured(bars, COLORS[2])


def bars_of(path: Path, rows: list[Row]) -> float:
    """Share of the upper panel that the first field covers."""
    write_byte_plot(path, rows, parts(rows), title="")
    picture = pixels_of(path)
    panel = picture[: int(0.7 * picture.shape[0]), : int(0.8 * picture.shape[1])]
    return coloured(panel, COLORS[0]) / panel[..., 0].size


def test_a_towering_key_packet_does_not_hide_the_others(tmp_path: Path) -> None:
    cut, whole = bars_of(tmp_path / "a.png", packets(11, key_times=50)), bars_of(tmp_path / "b.png", packets(11))
    assert cut > 0.8 * whole > 0.1
    keys = [replace(row, index=i) for i, row in enumerate(packets(50, key_times=3)[::5])]
    assert bars_of(tmp_path / "keys.png", keys) > 0.3


def test_a_long_stream_and_a_packet_alone(tmp_path: Path) -> None:
    assert bars_of(tmp_path / "long.png", packets(400)) > 0.1
    assert bars_of(tmp_path / "one.png", packets(1)) > 0.1
