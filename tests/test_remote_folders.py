# SPDX-License-Identifier: Apache-2.0
"""A URL is a folder, or a sentence that says why not."""

import sys
from pathlib import Path

import pytest

from structgstream.errors import MissingExtraError, StorageError
from structgstream.remote_folders import open_url, reason_of


def test_a_url_is_a_folder(tmp_path: Path) -> None:
    files, root = open_url(f"file://{tmp_path}")
    assert Path(root) == tmp_path
    files.pipe_file(f"{root}/a", b"content")
    assert (tmp_path / "a").read_bytes() == b"content"


def test_what_is_no_url_is_told() -> None:
    with pytest.raises(StorageError, match=r"^nonsense://a cannot be used as a store \(.*nonsense"):
        open_url("nonsense://a")


def test_without_its_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(MissingExtraError, match=r"'fsspec' is needed .*structgstream\[cloud\]"):
        open_url("memory://a")


def test_reasons_are_one_short_line() -> None:
    assert reason_of(ValueError("one\n  two")) == "one two"
    assert reason_of(Wordless()) == "Wordless"
    assert len(reason_of(ValueError("x" * 1000))) == 200


class Wordless(Exception):
    """Says nothing."""
