# SPDX-License-Identifier: Apache-2.0
"""Counters, and numbers of a run."""

import json

import pytest

from structgstream.serve.metrics import VIEWER_SECONDS, Viewers, run_numbers


def test_viewers_are_those_of_the_last_half_minute() -> None:
    seconds = 0.0
    viewers = Viewers(clock=lambda: seconds)
    viewers.see("a", ("x", 1))
    viewers.see("a", ("x", 2))
    seconds = VIEWER_SECONDS - 1
    viewers.see("a", ("x", 2))
    viewers.see("b", ("x", 2))
    assert viewers.counts() == {"a": 2, "b": 1}
    seconds = VIEWER_SECONDS + 1
    assert viewers.counts() == {"a": 1, "b": 1}
    for i in range(30_000):
        viewers.see("a", i)
    assert viewers.counts().total() == 10_000


def test_numbers_of_a_run() -> None:
    values = {"frames": 3, "Queue Length": {"cam-01": 2}, "live": True, "none": None, "text": "x", "list": [1], "": 4}
    assert run_numbers(json.dumps(values).encode()) == {
        "frames": 3.0, "queue_length_cam_01": 2.0, "live": 1.0, "unnamed": 4.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    "content", [b"", b"[1]", b"3", b"{", b'{"a": NaN}', b'{"a": 1e400}', b'{"a": ' + b"9" * 400 + b"}", b"{" * 90_000]
)
def test_what_has_no_numbers(content: bytes) -> None:
    assert run_numbers(content) == {}


def test_a_run_has_so_many_numbers() -> None:
    assert len(run_numbers(json.dumps({str(i): i for i in range(9999)}).encode())) == 500
