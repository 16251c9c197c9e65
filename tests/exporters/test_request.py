# SPDX-License-Identifier: Apache-2.0
"""Where an export goes and which frames it has, for every way to say it; ``cli/test_export.py`` has more refusals."""

import math
import re
from pathlib import Path

import pytest

from structgstream.errors import ConfigError
from structgstream.exporters.formats import (
    Format,
    FrameOptions,
    PageFormat,
    check_page,
    choose_frames,
    destination,
    is_one_file,
)

STREAM = Path("/videos/ball.sgs")


@pytest.mark.parametrize(
    ("output", "format", "frame", "expected"),
    [
        (None, None, None, ("/videos/ball-ply", "ply")),
        (None, "splat", 3, ("/videos/ball-3.splat", "splat")),
        (None, "html", None, ("/videos/ball.html", "html")),
        (None, "site", None, ("/videos/ball-site", "site")),
        ("out", None, None, ("out", "ply")),
        ("out", "spz", None, ("out", "spz")),
        ("one.SPZ", None, 2, ("one.SPZ", "spz")),
        ("page.html", None, None, ("page.html", "html")),
        ("my.obj", "ply", None, ("my.obj", "ply")),
        ("my.site", "site", None, ("my.site", "site")),
        (None, "usd", None, ("/videos/ball.usd", "usd")),
        (None, "usd", 3, ("/videos/ball-3.usd", "usd")),
        ("clip.usdc", None, None, ("clip.usdc", "usd")),
        ("set.zip", None, None, ("set.zip", "ply")),
        ("set.zip", "sog", None, ("set.zip", "sog")),
    ],
)
def test_the_place_and_the_format(
    output: str | None, format: Format | PageFormat | None, frame: int | None, expected: tuple[str, str]
) -> None:
    place = None if output is None else Path(output)
    assert destination(STREAM, place, format=format, frame=frame, frames=None) == (Path(expected[0]), expected[1])


def test_folders_of_segments_whose_names_have_dots_have_outputs_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Format | PageFormat, int | None, str]]
    asked = [("html", None, ".html"), ("usd", None, ".usd"), ("ply", 3, "-3.ply")]
    for day in ("27", "28"):
        stream = Path(f"/videos/studio.2026-11-{day}")
        for format, frame, ending in asked:
            found, _ = destination(stream, None, format=format, frame=frame, frames=None)
            assert found == Path(f"{stream}{ending}")
    (tmp_path / "ball").mkdir()
    monkeypatch.chdir(tmp_path / "ball")
    assert destination(Path("."), None, format="html", frame=None, frames=None)[0] == tmp_path / "ball.html"


def test_a_folder_that_is_there_is_a_folder_whatever_its_name(tmp_path: Path) -> None:
    folder = tmp_path / "set.ply"
    folder.mkdir()
    assert destination(STREAM, folder, format="spz", frame=None, frames=None) == (folder, "spz")
    assert not is_one_file(folder)
    assert is_one_file(tmp_path / "other.PLY")
    assert not is_one_file(tmp_path / "page.html")
    assert not is_one_file(tmp_path / "all.usd")
    with pytest.raises(ConfigError, match="contains all frames"):
        destination(STREAM, Path("x.zip"), format="usd", frame=None, frames=None)


def test_frames_of_a_stream_with_a_gap() -> None:
    runs, folder = [range(4), range(6, 8)], Path("out")
    assert choose_frames(runs, folder, frame=None, frames=None) == [0, 1, 2, 3, 6, 7]
    assert choose_frames(runs, folder, frame=None, frames=(1, 3)) == [1, 2, 3]
    assert choose_frames(runs, Path("x.ply"), frame=6, frames=None) == [6]
    assert choose_frames(runs, Path("x.ply"), frame=0, frames=None) == [0]
    for frame, frames in ((5, None), (None, (3, 6))):
        with pytest.raises(ConfigError, match="the stream has frames 0 to 3 and 6 to 7; there is no"):
            choose_frames(runs, folder, frame=frame, frames=frames)
    with pytest.raises(ConfigError, match="no whole frame"):
        choose_frames([], folder, frame=None, frames=None)


def test_degrees_that_a_format_supports() -> None:
    degrees = [FrameOptions(degree).baked_degree("ply") for degree in (None, 0, 3)]
    assert degrees == [1, 0, 3]
    assert FrameOptions().baked_degree("splat") == 0


@pytest.mark.parametrize(
    ("options", "format", "words"),
    [
        (FrameOptions(degree=-1), "spz", "--sh-degree -1 is not one of 0 to 3"),
        (FrameOptions(degree=4), "spz", "--sh-degree 4 is not one of 0 to 3"),
        (FrameOptions(degree=1), "splat", "one colour per Gaussian"),
        (FrameOptions(low_pass=-0.1), "ply", "expected 0 to 1"),
        (FrameOptions(low_pass=math.nan), "ply", "expected 0 to 1"),
        (FrameOptions(min_opacity=1.0), "ply", "without 1"),
        (FrameOptions(max_splats=0), "ply", "leaves no Gaussian"),
        (FrameOptions(box=(0, 0, 0, 1, -1, 1)), "ply", "no volume"),
        (FrameOptions(pad_sh=True), "spz", "--pad-sh is for .ply"),
        (FrameOptions(spz_version=4), "ply", "--spz-version is for .spz"),
    ],
)
def test_options_that_make_no_sense(options: FrameOptions, format: Format, words: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(words)):
        options.check(format)


def test_a_page_has_no_options() -> None:
    check_page(frame=None, frames=None, options=FrameOptions())
    for wish in ({"frame": 0}, {"frames": (0, 0)}, {"options": FrameOptions(low_pass=0.2)}):
        with pytest.raises(ConfigError, match="a page contains the whole stream"):
            check_page(**{"frame": None, "frames": None, "options": FrameOptions(), **wish})
