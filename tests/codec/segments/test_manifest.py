# SPDX-License-Identifier: Apache-2.0
"""The values of a manifest, and the names of files."""

import hashlib
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.segments.manifest import (
    MANIFEST,
    history_name,
    init_name,
    part_name,
    segment_name,
    sha256_of,
)
from structgstream.codec.segments.store import is_ours
from tests.support.properties import examples
from tests.support.segment_folders import GrowingFolder
from tests.support.streams import small_stream


def test_the_documented_names() -> None:
    digest = "0123456789abcdef" + "0" * 48
    assert init_name(0, digest) == "init-0000-0123456789abcdef.sgs"
    assert part_name(371, digest) == "part-00000371-0123456789abcdef.sgs"
    assert segment_name(11, digest) == "segment-00000011-0123456789abcdef.sgs"
    assert history_name(0, digest) == "history-00000000-0123456789abcdef.json"
    assert part_name(10**9, digest) == "part-1000000000-0123456789abcdef.sgs"


@given(st.integers(0, 2**40), st.binary(max_size=10))
@examples(200)
def test_every_name_is_known_as_ours_and_none_stands_for_other_content(number: int, content: bytes) -> None:
    names = [name(number, sha256_of(content)) for name in (init_name, part_name, segment_name, history_name)]
    assert all(is_ours(name) for name in names)
    assert len(set(names)) == 4
    assert not {name(number, sha256_of(content + b"x")) for name in (init_name, part_name, segment_name)} & set(names)


def test_the_hash_is_sha_256() -> None:
    assert sha256_of(b"abc") == hashlib.sha256(b"abc").hexdigest()


def test_a_manifest_names_all_files_but_itself(tmp_path: Path) -> None:
    growing = GrowingFolder(tmp_path, small_stream(4))
    for _ in range(2):
        growing.write()
    manifest = growing.write()
    assert {*manifest.files, MANIFEST} == {path.name for path in tmp_path.iterdir()}
    assert len(manifest.files) == 4
    manifest = growing.write()  # a key frame: the group is a segment as well
    assert len(manifest.files) == 3
