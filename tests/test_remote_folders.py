# SPDX-License-Identifier: Apache-2.0
"""A URL is a folder, or a sentence that says why not."""

import sys
from pathlib import Path

import pytest

from structgstream.codec.segments.store import CloudStore
from structgstream.data.live.rig_file import read_rig
from structgstream.errors import CaptureError, MissingExtraError, StorageError
from structgstream.parallel.exchange import ObjectFolder
from structgstream.remote_folders import open_url, reason_of, shown_address, without_secrets


def test_what_is_no_url_is_reported() -> None:
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


SECRET_ADDRESSES = {
    "rtsp://admin:p4ss@10.0.0.11/stream": "rtsp://10.0.0.11/stream",
    "rtsp://admin:p@p4ss@10.0.0.11:554/stream": "rtsp://10.0.0.11:554/stream",
    "rtsp://admin:x/p4ss@h/stream": "rtsp://h/stream",
    "rtsp://admin:x#p4ss@h/stream": "rtsp://h/stream",
    "rtsp://admin:x@y/p4ss@h/stream": "rtsp://h/stream",
    "rtsp://p4ss@h": "rtsp://h",
    "http://h/video?user=p4ss&password=p4ss&channel=1": "http://h/video?user=***&password=***&channel=1",
    "http://h/video?p4ss": "http://h/video?***",
    "rtsp://h:554/user=admin&password=p4ss&channel=1&stream=0.sdp": "rtsp://h:554/user=***&password=***&channel=1&stream=0.sdp",
    "rtsp://h/user=admin_password=p4ss_channel=1": "rtsp://h/user=***",
    "s3://AKIA:p4ss@bucket/runs": "s3://bucket/runs",
    "srt://h:9000?streamid=p4ss&passphrase=p4ss": "srt://h:9000?streamid=***&passphrase=***",
}


@pytest.mark.parametrize(("address", "shown"), SECRET_ADDRESSES.items())
def test_secrets_of_an_address_are_not_shown(address: str, shown: str) -> None:
    assert shown_address(address) == shown
    assert "p4ss" not in without_secrets(f"[Errno 111] Connection refused: '{address}'", address)


@pytest.mark.parametrize(
    "address", ["rtsp://h:554/a@b", "udp://239.0.0.1:5000", "/dev/video0", "take/cam1.mkv", "s3://b/r"]
)
def test_addresses_without_secrets_name_their_host(address: str) -> None:
    assert shown_address(address) == (address if address != "rtsp://h:554/a@b" else "rtsp://b")


def test_every_place_that_prints_an_address_leaves_secrets_out(tmp_path: Path) -> None:
    for address in SECRET_ADDRESSES:
        nonsense = f"nonsense://{address.partition('://')[2]}"
        for open_place in (open_url, ObjectFolder, CloudStore):
            with pytest.raises(StorageError) as refused:
                open_place(nonsense)
            assert "p4ss" not in str(refused.value)
    rig = tmp_path / "rig.toml"
    for line in ('a = "rtsp://u:p4ss@h"', "a = {url = 1, options = {password = 'p4ss'}}", "a = {options = ['p4ss']}"):
        rig.write_text(f"calibration = 'take'\n[cameras]\n{line}\n")
        with pytest.raises(CaptureError) as broken:
            read_rig(rig)
        assert "p4ss" not in str(broken.value)
