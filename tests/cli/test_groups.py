# SPDX-License-Identifier: Apache-2.0
"""Header, track, groups and joining by commands, as a shell loop gives them."""

from pathlib import Path

import pytest

from structgstream.cli import main
from structgstream.codec.reader import open_stream
from tests.support.backends import QUICKEST
from tests.support.quick_streams import CLIP, QUARTER

pytestmark = pytest.mark.usefixtures("quick_tiny")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``header.sgs``, ``track``, and segments ``g0.sgs`` and ``g2.sgs``."""
    folder = tmp_path_factory.mktemp("groups")
    assert main(["reconstruct", CLIP, "-o", str(folder / "header.sgs"), "--frames", "1", *QUARTER]) == 0
    assert main([*track(folder), "--groups", "2", "--allow-unaligned", "--frames", "4"]) == 0
    for line in (folder / "track.groups").read_text().split():
        assert main(group(folder, line)) == 0
    return folder


def track(folder: Path) -> list[str]:
    given = ["--init", str(folder / "header.sgs"), "-o", str(folder / "track"), "--device", QUICKEST]
    return ["track", CLIP, *given]


def group(folder: Path, frames: str) -> list[str]:
    given = ["--init", str(folder / "header.sgs"), "--track", str(folder / "track"), "--frames", frames]
    output = str(folder / f"g{frames.split(':')[0]}.sgs")
    return ["fit-group", CLIP, *given, "-o", output, "--device", QUICKEST, "--iterations", "4"]


def test_a_shell_loop_makes_an_ordinary_stream(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.sgs"
    assert main(["join", str(made / "g2.sgs"), str(made / "g0.sgs"), "-o", str(out), "--check"]) == 0
    assert "4 frames of 2 groups" in capsys.readouterr().out
    with open_stream(out) as reader:
        assert (len(reader), reader.complete) == (4, True)
    assert main(["evaluate", str(out), CLIP, "--metrics", "basic", "--device", QUICKEST]) == 0
    assert main(["inspect", str(out)]) == 0


def test_commands_given_again_say_that_all_is_done(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*track(made), "--groups", "2", "--allow-unaligned", "--frames", "4"]) == 0
    assert "2 groups in" in capsys.readouterr().out
    assert main(group(made, "2:4")) == 0
    assert "is finished" in capsys.readouterr().out


def test_what_is_refused(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*track(made), "--groups", "7"]) == 2
    assert "one every 30 frames" in capsys.readouterr().err
    assert main(group(made, "4")) == 2
    assert "a group is A:B" in capsys.readouterr().err
    assert main(group(made, "4:4")) == 2
    assert main([*group(made, "2:4"), "--preset", "tiny"]) == 2
    assert main(["join", "-o", str(tmp_path / "a.sgs")]) == 2
    assert main(["join", str(made / "g2.sgs"), "-o", str(tmp_path / "a.sgs")]) == 1
    assert "are missing" in capsys.readouterr().err
    assert main(["join", str(made / "g2.sgs"), "-o", str(made / "g0.sgs")]) == 2
