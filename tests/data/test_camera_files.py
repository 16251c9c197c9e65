# SPDX-License-Identifier: Apache-2.0
"""Whole captures are opened in ``test_found_calibrations`` and ``tests/preparation/test_footage``.

Which files of a folder are a capture's: not those that systems and the check leave beside them.
"""

from pathlib import Path

import pytest

from structgstream.data.camera_files import REPORT, videos_in
from structgstream.data.open import open_capture
from structgstream.errors import CaptureError
from tests.support import captures
from tests.support.captures import numbers, picture, write_clip, write_n3dv, write_picture, write_videos


def test_videos_in_folders_of_cameras(tmp_path: Path) -> None:
    assert videos_in(tmp_path / "nowhere") == {}
    for camera in ("left", "right"):
        write_videos(tmp_path / camera, ["GX010001"], frames=2)
    assert videos_in(tmp_path) == {name: tmp_path / name / "GX010001.mp4" for name in ("left", "right")}
    write_videos(tmp_path, ["middle"], frames=2)
    assert videos_in(tmp_path) == {"middle": tmp_path / "middle.mp4"}


APPLE_DOUBLE = b"\0\5\x16\7"


def colmap(where: Path) -> None:
    rig = write_n3dv(where / "poses")
    captures.write_text_model(where / "sparse", rig, [(f"{name}.png", name) for name in rig])
    captures.write_pictures(where, "CAM/FRAME.png", rig, frames=1)
    for name in rig:
        (where / name / "._000000.png").write_bytes(APPLE_DOUBLE)


def test_what_a_mac_leaves_beside_files_is_no_camera_and_no_frame(tmp_path: Path) -> None:
    for layout, write in (("json", write_clip), ("n3dv", write_n3dv)):
        rig = write(tmp_path / layout)
        (tmp_path / layout / "._cam00.mp4").write_bytes(APPLE_DOUBLE)
        assert list(open_capture(tmp_path / layout).rig) == list(rig)
    colmap(tmp_path / "colmap")
    assert len(open_capture(tmp_path / "colmap")) == 1


def test_the_report_of_a_check_is_no_camera(tmp_path: Path) -> None:
    """``prepare --check`` leaves it in the capture, with a picture of each camera."""
    colmap(tmp_path)
    before = list(open_capture(tmp_path).rig)
    write_picture(tmp_path / REPORT / "camera_cam00.png", picture(0, 0))
    source = open_capture(tmp_path)
    assert list(source.rig) == before
    assert numbers(next(source.frames()).images["cam01"])[0] == 1


def test_a_picture_twice_is_not_chosen_by_chance(tmp_path: Path) -> None:
    colmap(tmp_path)
    write_picture(tmp_path / "cam01" / "000000.jpg", picture(0, 0))
    with pytest.raises(CaptureError, match=r"000000\.jpg and 000000\.png in .*cam01 are of one name"):
        open_capture(tmp_path)
