# SPDX-License-Identifier: Apache-2.0
"""Which names may stand in an address."""

import string
from pathlib import PurePosixPath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from properties import examples
from structgstream.codec.segments.manifest import history_name, init_name, part_name, segment_name
from structgstream.server.names import hash_in_name, is_plain_path, is_stream_name

PLAIN = string.ascii_letters + string.digits + "._-"


@pytest.mark.parametrize("name", ["a", "ball.sgs", "A_b-c.9", "-x", "x" * 128])
def test_names_of_streams(name: str) -> None:
    assert is_stream_name(name)


@pytest.mark.parametrize("name", ["", ".", "..", ".a", "a/b", "a b", "a\n", "a%", "~", "ä", "x" * 129, "a\\b", "a:b"])
def test_no_names_of_streams(name: str) -> None:
    assert not is_stream_name(name)


def test_names_of_immutable_files() -> None:
    digits = "0123456789abcdef"
    for name in ("init-0000", "part-00000001", "segment-00000001", "segment-123456789"):
        assert hash_in_name(f"{name}-{digits}.sgs") == digits
    assert hash_in_name(f"history-00000000-{digits}.json") == digits
    for name in (
        "manifest.json", f"part-00000001-{digits}.json", f"part-00000001-{digits}.sgs.partial", "part-00000001.sgs",
        f"part-00000001-{digits.upper()}.sgs", f"xpart-00000001-{digits}.sgs", f"part-00000001-{digits}.sgs\n",
        f"history-00000000-{digits}.sgs", f".new-part-00000001-{digits}.sgs", "",
    ):  # fmt: skip
        assert hash_in_name(name) is None, name


def test_plain_paths() -> None:
    for path in (b"/", b"/streams/a.b-c_d/x", b"/a//b", b"/..."):
        assert is_plain_path(path)
    for path in (b"", b"a", b"/%61", b"/a/../b", b"/./a", b"/a/..", b"/a\\b", b"/a;b", b"/a b", b"/\xc3\xa4", b"/a\n"):
        assert not is_plain_path(path)


@given(st.text(max_size=8) | st.text(PLAIN + "/%~", max_size=8))
@examples(400)
def test_a_name_of_a_stream_is_one_part_of_an_address_as_it_stands(name: str) -> None:
    """What is served can be asked for: its path is plain, is one folder, and leads nowhere else."""
    if is_stream_name(name):
        path = f"/streams/{name}/"
        assert is_plain_path(path.encode("ascii"))
        assert PurePosixPath(path).parts == ("/", "streams", name)
        assert not name.startswith(".")


@given(st.lists(st.text(PLAIN, max_size=4), max_size=5))
@examples(400)
def test_a_plain_path_never_leads_up(parts: list[str]) -> None:
    path = "/" + "/".join(parts)
    assert is_plain_path(path.encode()) == (not {".", ".."} & set(parts))


@given(st.integers(0, 2**32 - 1), st.binary(max_size=4))
@examples(200)
def test_the_hash_is_found_in_every_name_that_a_writer_gives(number: int, data: bytes) -> None:
    digest = data.hex().ljust(64, "0")
    for name in (init_name, part_name, segment_name, history_name):
        file = name(number, digest)
        assert hash_in_name(file) == digest[:16]
        assert is_plain_path(f"/{file}".encode())
