# SPDX-License-Identifier: Apache-2.0
import json
from pathlib import Path

import pytest

from structgstream.codec.segments.quality_list import (
    QUALITIES,
    ListedQuality,
    is_quality_name,
    list_from_json,
    list_to_json,
    read_list,
    write_list,
)
from structgstream.errors import StreamError
from tests.support.killed import folders_of_the_killed

LOW, HIGH = ListedQuality("low", "low/manifest.json", 1.5e6), ListedQuality("high", "high/manifest.json", 6e6)


def test_a_list_comes_back_as_players_read_it(tmp_path: Path) -> None:
    write_list(tmp_path, (LOW, HIGH))
    assert read_list(tmp_path) == (LOW, HIGH)
    values = json.loads((tmp_path / QUALITIES).read_text())
    assert (values["format"], values["version"]) == ("structgstream-qualities", 1)
    assert values["qualities"][0] == {"name": "low", "manifest": "low/manifest.json", "bits_per_second": 1.5e6}
    assert read_list(tmp_path / "none") is None
    assert read_list(tmp_path / QUALITIES) is None


def test_whoever_reads_gets_one_list_or_the_other(tmp_path: Path) -> None:
    """Whenever the process that refreshes it is killed."""
    folders = folders_of_the_killed(
        tmp_path, lambda folder: write_list(folder, (HIGH, LOW)), begin=lambda folder: write_list(folder, (LOW, HIGH))
    )
    found = [read_list(folder) for folder in folders]
    assert set(found) == {(LOW, HIGH), (HIGH, LOW)}
    assert found[-1] == (HIGH, LOW)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"format": "else"}, "is no list of qualities"),
        ({"version": 2}, "Install a newer"),
        ({"qualities": []}, "lists no quality"),
        ({"qualities": [{}] * 9}, "at most 8"),
        ({"qualities": [{"name": "a", "manifest": "../x", "bits_per_second": 1}]}, "plain path of a manifest"),
        ({"qualities": [{"name": "a", "manifest": "/x", "bits_per_second": 1}]}, "plain path of a manifest"),
        ({"qualities": [{"name": "a", "manifest": "a/x", "bits_per_second": 0}]}, "a number from 1"),
        ({"qualities": [{"manifest": "a/x", "bits_per_second": 1}]}, "has no 'name'"),
    ],
)
def test_what_is_no_list_is_refused(changed: dict[str, object], said: str) -> None:
    values = json.loads(list_to_json((LOW, HIGH))) | changed
    with pytest.raises(StreamError, match=said):
        list_from_json(json.dumps(values).encode(), name="x")


def test_which_folder_a_quality_is() -> None:
    assert (LOW.folder, ListedQuality("x", "a/b/manifest.json", 1.0).folder) == ("low", None)
    assert ListedQuality("x", "manifest.json", 1.0).folder is None
    assert ListedQuality("x", "low/other.json", 1.0).folder is None


def test_names() -> None:
    assert all(map(is_quality_name, ("low", "1080p", "a-b_c")))
    assert not any(map(is_quality_name, ("", "a.b", "a/b", ".a", "ü", "a b", "x" * 65)))
