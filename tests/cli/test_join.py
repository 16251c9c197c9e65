# SPDX-License-Identifier: Apache-2.0
"""``join`` of small segments, and what it refuses: nothing is written then."""

from pathlib import Path

import pytest

from structgstream.cli import main
from structgstream.codec.reader import open_stream
from structgstream.groups.join import join_segments
from tests.support.quick_streams import error_of
from tests.support.small_segments import FIRST, FROM_FRAME_0, encoded, write


@pytest.fixture
def segments(tmp_path: Path) -> list[str]:
    (tmp_path / "g").mkdir()
    first = write(tmp_path / "g" / "g0.sgs", encoded(1, FIRST)[0], identity=FROM_FRAME_0)
    return [str(first), str(write(tmp_path / "g" / "g3.sgs", encoded()[0]))]


def test_segments_become_a_stream_in_any_order(
    segments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.sgs"
    assert main(["join", *reversed(segments), "-o", str(out)]) == 0
    assert f"Wrote {out}: 7 frames of 2 groups, " in capsys.readouterr().out
    with open_stream(out) as reader:
        assert (len(reader), reader.complete) == (7, True)
    assert main(["join", segments[0], "-o", str(out), "--overwrite"]) == 0
    assert "3 frames of 1 groups" in capsys.readouterr().out


def test_plain_copies_the_packets_of_every_group(segments: list[str], tmp_path: Path) -> None:
    out, copied = tmp_path / "out.sgs", tmp_path / "copied.sgs"
    assert main(["join", *segments, "-o", str(out), "--plain"]) == 0
    join_segments([Path(segment) for segment in segments], copied)
    assert out.read_bytes() == copied.read_bytes()


def test_what_is_there_is_replaced_only_when_asked(
    segments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.sgs"
    out.write_bytes(b"mine")
    error = error_of(["join", *segments, "-o", str(out)], capsys, status=2)
    assert error == f"structgstream: {out} exists; replace it with --overwrite, or choose another name.\n"
    assert out.read_bytes() == b"mine"


def test_what_is_refused_is_one_sentence_and_leaves_nothing(
    segments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, cut = tmp_path / "out.sgs", tmp_path / "cut.sgs"
    cut.write_bytes(Path(segments[1]).read_bytes()[:-40])
    for given, status, said in (
        ([], 2, "join needs the segments of a stream."),
        (segments[1:], 1, "Frames 0 to 2 are missing"),
        ([*segments, segments[1]], 1, "Frames 3 to 6 are duplicated"),
        ([segments[0], str(cut)], 1, "cut.sgs is not finished or damaged"),
        ([str(tmp_path / "absent.sgs")], 1, "Cannot read"),
    ):
        error = error_of(["join", *given, "-o", str(out)], capsys, status=status)
        assert said in error
        assert error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cut.sgs", "g"]
