# SPDX-License-Identifier: Apache-2.0
"""Ranges as in RFC 9110, validators, and files in pieces."""

import asyncio
import os
from pathlib import Path

import pytest
from starlette.requests import Request
from starlette.types import Message

from structgstream.serve.responses import (
    PIECE_BYTES,
    file_response,
    requested_range,
)
from structgstream.serve.streams import open_below

SIZE = 1000


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("bytes=0-0", range(1)),
        ("bytes=0-499", range(500)),
        ("bytes=500-999", range(500, 1000)),
        ("bytes=500-", range(500, 1000)),
        ("bytes=999-5000", range(999, 1000)),
        ("bytes=-1", range(999, 1000)),
        ("bytes=-5000", range(1000)),
        ("BYTES= 3-4 ", range(3, 5)),
    ],
)
def test_ranges(header: str, expected: range) -> None:
    assert requested_range(header, SIZE) == expected


@pytest.mark.parametrize("header", ["bytes=1000-", "bytes=1000-1001", "bytes=-0", "bytes=999999999999999999-"])
def test_nothing_of_it_is_there(header: str) -> None:
    assert requested_range(header, SIZE) == range(0)


@pytest.mark.parametrize("header", ["bytes=0-", "bytes=-5", "bytes=0-0"])
def test_an_empty_file_has_no_range(header: str) -> None:
    assert requested_range(header, 0) == range(0)


@pytest.mark.parametrize(
    "header",
    [
        None,
        "",
        "bytes=",
        "bytes=-",
        "bytes=5",
        "bytes=7-3",
        "bytes=0-1,4-5",
        "items=0-5",
        "bytes=a-b",
        "bytes=٣-٤",
        "bytes=--5",
        "bytes=" + "9" * 400 + "-",
        "bytes=0-1\nbytes=2-3",
        "bytes=0x10-0x20",
        "bytes=0-0," * 400,
        "bytes=0-18446744073709551616",
        "bytes=-99999999999999999999999",
        "=",
    ],
)
def test_what_counts_as_no_range(header: str | None) -> None:
    assert requested_range(header, SIZE) is None


async def answer(path: Path, headers: dict[str, str], method: str, *, etag: str | None) -> tuple[int, bytes]:
    """Status and body of the response to a request for a file."""
    opened, sent = open_below(path.parent, path.name), list[Message]()
    assert opened is not None
    scope = {
        "type": "http",
        "method": method,
        "headers": [(name.encode(), text.encode()) for name, text in headers.items()],
    }

    async def receive() -> Message:
        await asyncio.Event().wait()
        raise AssertionError

    async def send(message: Message) -> None:
        sent.append(message)

    await file_response(opened, Request(scope), {}, etag=etag)(scope, receive, send)
    return sent[0]["status"], b"".join(message.get("body", b"") for message in sent[1:])


def test_a_large_file_is_sent_in_pieces_and_closed(tmp_path: Path) -> None:
    path, content = tmp_path / "file", os.urandom(2 * PIECE_BYTES + 3)
    path.write_bytes(content)
    before = len(os.listdir("/proc/self/fd"))
    for headers, etag, expected in (
        ({}, None, (200, content)),
        ({"range": f"bytes=1-{PIECE_BYTES + 1}"}, None, (206, content[1 : PIECE_BYTES + 2])),
        ({"range": f"bytes={len(content)}-"}, None, (416, b"")),
        ({"if-none-match": '"a"'}, '"a"', (304, b"")),
        ({"range": "bytes=0-4", "if-range": '"a"'}, '"a"', (206, content[:5])),
        ({"range": "bytes=0-4", "if-range": '"b"'}, '"a"', (200, content)),
        ({"range": "bytes=0-4", "if-range": '"a"'}, None, (200, content)),
    ):
        assert asyncio.run(answer(path, headers, "GET", etag=etag)) == expected
        status, body = asyncio.run(answer(path, headers, "HEAD", etag=etag))
        assert (status, body) == (expected[0], b"")
    assert len(os.listdir("/proc/self/fd")) <= before
