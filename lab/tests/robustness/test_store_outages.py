# SPDX-License-Identifier: Apache-2.0
"""The benchmark of stores in trouble: in small it runs, and it counts what a reader does not find."""

import random
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from lab.robustness.store_outages import KINDS, Reader, Row, one_event, services, table
from repeated_streams import small_sent
from tests.support.segment_streams import folder, packets, written

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")


@pytest.fixture(scope="module")
def s3() -> Iterator[object]:
    pytest.importorskip("s3fs", reason="s3fs, of the extra cloud, is not installed")
    pytest.importorskip("moto.server", reason="moto, of the extra dev, is not installed")
    with services() as running:
        yield running


@pytest.mark.parametrize(
    "kind", ["refuses connections", "denies access", "breaks off", "stores and breaks off", "loses its files"]
)
def test_a_store_in_trouble_costs_nothing(s3: object, tmp_path: Path, kind: str) -> None:
    assert kind in KINDS
    row = Row(kind)
    one_event(row, small_sent(8), random.Random(0), tmp_path / kind.replace(" ", "-"), seconds=0.2, s3=s3)
    assert (row.events, row.equal) == (1, 1)
    assert len(row.seconds_until_normal) == len(row.longest_write_seconds) == 1
    assert f"| {kind} | 1 | 1 |" in table([row])


def test_a_reader_notes_what_a_manifest_names_and_is_not_there(s3: object, tmp_path: Path) -> None:
    _, _, other = s3  # type: ignore[misc]
    here, there = folder(tmp_path / "here"), other.store("broken")
    written(here, packets(4))
    for name in sorted(here.names()):
        if not name.startswith("segment-00000000"):
            there.put(name, here.get(name))
    reader = Reader(there, b"")
    reader.start()
    while not reader.refused:
        time.sleep(0.01)
    reader.end()
    assert reader.reads
