# SPDX-License-Identifier: Apache-2.0
"""From videos with a calibration to a capture: steps, resuming, and what is refused."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from structgstream.data.open import open_capture
from structgstream.data.prepared import read_prepared
from structgstream.preparation.options import Distance, PrepareOptions
from structgstream.preparation.prepare import Job, prepare_capture
from tests.support.captures import write_picture
from tests.support.planes import room_frame
from tests.support.rooms import write_room

OPTIONS = PrepareOptions(synchronize="none")


def test_a_capture_is_made_once_and_only_what_changed_again(tmp_path: Path) -> None:
    rig = write_room(tmp_path / "videos")
    made = prepare_capture(tmp_path / "videos", tmp_path / "out", options=OPTIONS)
    assert made.skipped == ()
    assert not [finding for finding in made.findings if finding.severity == "error"]
    assert made.report.is_file()
    source = open_capture(tmp_path / "out")
    assert (len(source), source.fps) == (2, 30.0)
    assert source.points is not None
    for name in rig:
        assert torch.equal(source.rig[name].viewmat, rig[name].viewmat)
        assert 0.6 < source.rig[name].near < 1.4  # the board stands 2.5 in front of the cameras
    assert made.steps["sound"] == "no camera has any"
    assert read_prepared(tmp_path / "out").sound is None
    again = prepare_capture(tmp_path / "videos", tmp_path / "out", options=OPTIONS)
    assert set(again.skipped) == {"synchronize", "calibrate", "scale", "near", "points", "check", "sound"}
    assert again.findings == made.findings
    distance = Distance("cam00", "cam04", 2.0)
    metres = prepare_capture(tmp_path / "videos", tmp_path / "out", options=replace(OPTIONS, distance=distance))
    assert set(metres.skipped) == {"synchronize", "calibrate", "sound"}
    found = read_prepared(tmp_path / "out")
    assert found.unit == "metres"
    one, other = (found.cameras[name].pinhole.center for name in ("cam00", "cam04"))
    assert float((one - other).norm()) == pytest.approx(2.0)


def write_pictures(folder: Path, frames: int) -> None:
    """The room as folders of pictures, a corner of which holds the frame's number."""
    rig = write_room(folder, cameras=4)
    for name, image in room_frame(rig).images.items():
        (folder / f"{name}.mp4").unlink()
        for frame in range(frames):
            numbered = image.copy()
            numbered[:10, :10] = 40 * frame
            write_picture(folder / name / f"{frame:04d}.png", numbered)


def carried(capture: Path) -> list[dict[str, int]]:
    return [
        {name: int(image[3, 3, 0]) // 40 for name, image in frame.images.items()}
        for frame in open_capture(capture).frames()
    ]


def test_a_picture_that_lacks_is_no_other_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the first time, or deleted between two runs: its camera is absent there, and in step after it."""
    monkeypatch.setattr(Job, "points", lambda self, content: content)
    monkeypatch.setattr(Job, "check", lambda self, content: ())
    options = replace(OPTIONS, near=0.3)
    write_pictures(tmp_path / "videos", 5)
    names = ("cam00", "cam01", "cam02", "cam03")
    prepare_capture(tmp_path / "videos", tmp_path / "out", options=options)
    assert carried(tmp_path / "out") == [dict.fromkeys(names, frame) for frame in range(5)]
    (tmp_path / "videos" / "cam02" / "0003.png").unlink()
    for out in ("out", "new"):
        prepare_capture(tmp_path / "videos", tmp_path / out, options=options)
        wanted = [dict.fromkeys(names, frame) for frame in range(5)]
        del wanted[3]["cam02"]
        assert carried(tmp_path / out) == wanted
    assert (tmp_path / "videos" / "cam02" / "0004.png").is_file()


def test_an_interrupted_preparation_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    write_room(tmp_path / "videos", cameras=4)
    monkeypatch.setattr(Job, "check", lambda self, content: ())
    with monkeypatch.context() as patched:
        patched.setattr("structgstream.preparation.prepare.frame_points", interrupt)
        with pytest.raises(KeyboardInterrupt):
            prepare_capture(tmp_path / "videos", tmp_path / "out", options=OPTIONS)
    assert len(open_capture(tmp_path / "out")) == 2
    made = prepare_capture(tmp_path / "videos", tmp_path / "out", options=OPTIONS)
    assert "near" in made.skipped
    assert "points" not in made.skipped
