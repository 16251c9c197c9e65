# SPDX-License-Identifier: Apache-2.0
import logging
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.timeline import Clock
from structgstream.errors import CaptureError
from structgstream.opus import SAMPLE_RATE
from structgstream.preparation.footage import find_footage, shared_seconds, shots_of, spread_moments
from tests.support.captures import numbers, picture, write_picture, write_video, write_videos
from tests.support.sounds import add_sound


def test_videos_in_natural_order(tmp_path: Path) -> None:
    write_videos(tmp_path, ["cam10", "cam2", "cam1"], frames=5)
    footage = find_footage(tmp_path)
    assert footage.cameras == ("cam1", "cam2", "cam10")
    assert footage.size("cam2") == (64, 48)
    assert footage.fps == 30.0
    assert footage.stamps("cam2") == pytest.approx(np.arange(5) / 30)
    assert footage.audio("cam1") is None


def test_chosen_pictures_of_a_long_video(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", [picture(1, frame % 200) for frame in range(200)])
    footage = find_footage(tmp_path)
    wanted = [0, 1, 7, 90, 91, 199]
    assert [numbers(image)[1] for image in footage.pictures("a", wanted)] == wanted


@pytest.mark.parametrize("below", ["", "videos"])
def test_a_folder_per_camera_with_its_video(tmp_path: Path, below: str) -> None:
    for number, name in enumerate(("left", "right")):
        write_video(tmp_path / below / name / f"GX0100{number}.mp4", [picture(number, 0)] * 2)
    (tmp_path / "masks").mkdir()
    footage = find_footage(tmp_path)
    assert footage.cameras == ("left", "right")
    assert footage.files["right"].name == "GX01001.mp4"


def test_folders_of_pictures_and_single_pictures(tmp_path: Path) -> None:
    for frame in range(3):
        write_picture(tmp_path / "many" / "images" / "a" / f"{frame}.png", picture(1, frame))
        write_picture(tmp_path / "one" / f"cam{frame}.png", picture(frame, 0))
    many = find_footage(tmp_path / "many", picture_fps=25)
    assert many.stamps("a") == pytest.approx([0, 0.04, 0.08])
    assert [numbers(image)[1] for image in many.pictures("a", [0, 2])] == [0, 2]
    one = find_footage(tmp_path / "one")
    assert one.cameras == ("cam0", "cam1", "cam2")
    assert one.stamps("cam1").tolist() == [0.0]
    assert one.only(["cam2", "cam0"]).cameras == ("cam0", "cam2")


@pytest.mark.parametrize("delay_seconds", [0.0, 0.1])
def test_sound_is_on_the_pictures_clock(tmp_path: Path, delay_seconds: float) -> None:
    """A click at second 0.2 of the pictures' clock; the sound begins late."""
    write_video(tmp_path / "silent.mp4", [picture(0, number) for number in range(30)])
    click = np.zeros((1, SAMPLE_RATE // 2), np.float32)
    click[0, round((0.2 - delay_seconds) * SAMPLE_RATE)] = 0.9
    (tmp_path / "take").mkdir()
    add_sound(tmp_path / "silent.mp4", tmp_path / "take" / "a.mkv", click, start=delay_seconds, codec="pcm_f32le")
    found = find_footage(tmp_path / "take").audio("a")
    assert found is not None
    assert np.abs(found).argmax() / SAMPLE_RATE == pytest.approx(0.2, abs=0.002)


def test_what_is_no_footage_is_reported(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"is missing; give the folder that holds the cameras' videos"):
        find_footage(tmp_path / "nowhere")
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(CaptureError, match=r"holds no videos and no pictures, but notes\.txt; expected CAMERA\.mp4"):
        find_footage(tmp_path)
    with pytest.raises(CaptureError, match="is a file"):
        find_footage(tmp_path / "notes.txt")
    (tmp_path / "new").mkdir()
    with pytest.raises(CaptureError, match=r"new is empty; expected CAMERA\.mp4"):
        find_footage(tmp_path / "new")


def test_a_folder_of_a_camera_is_not_lost_unnoticed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("a", "b"):
        write_picture(tmp_path / name / "0.png", picture(0, 0))
    (tmp_path / "masks").mkdir()
    assert find_footage(tmp_path).cameras == ("a", "b")
    assert not caplog.records
    (tmp_path / "c").mkdir()
    with pytest.raises(CaptureError, match=r"c is empty; copy what camera 'c' filmed into it"):
        find_footage(tmp_path)
    (tmp_path / "c" / "notes.txt").write_text("")
    with caplog.at_level(logging.WARNING):
        assert find_footage(tmp_path).cameras == ("a", "b")
    assert "c is left out: it holds no picture" in caplog.text


def test_pictures_of_another_size_are_named(tmp_path: Path) -> None:
    write_picture(tmp_path / "a" / "0.png", picture(0, 0))
    write_picture(tmp_path / "a" / "1.png", picture(0, 0)[:-2])
    footage = find_footage(tmp_path)
    with pytest.raises(CaptureError, match=r"1\.png has \d+x\d+ pixels, the first one of camera 'a' \d+x\d+; expected"):
        list(footage.pictures("a", [0, 1]))


def test_ambiguous_files_are_reported(tmp_path: Path) -> None:
    write_videos(tmp_path / "twice", ["a"], frames=2)
    write_videos(tmp_path / "twice" / "a", ["b"], frames=2)
    with pytest.raises(CaptureError, match=r"b\.mp4 and a\.mp4 in .* are both of camera 'a'|a\.mp4 and b\.mp4"):
        find_footage(tmp_path / "twice")
    write_videos(tmp_path / "chapters" / "left", ["GX01", "GX02"], frames=2)
    with pytest.raises(CaptureError, match=r"camera 'left' holds 2 videos .*join the chapters"):
        find_footage(tmp_path / "chapters")


def test_a_damaged_video_names_its_camera(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", [picture(0, frame) for frame in range(40)])
    file = tmp_path / "a.mp4"
    data = bytearray(file.read_bytes())
    begin = data.index(b"mdat") + 4
    data[begin + (len(data) - begin) // 3 :] = bytes(len(data) - begin - (len(data) - begin) // 3)
    footage = find_footage(tmp_path)
    file.write_bytes(bytes(data))
    with pytest.raises(CaptureError, match=r"a\.mp4 of camera 'a' cannot be decoded .* go on without it"):
        list(footage.pictures("a", range(40)))


def test_what_a_mac_and_a_check_leave_is_no_footage(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_picture(tmp_path / "pictures" / name / "0.png", picture(0, 0))
        (tmp_path / "pictures" / name / "._0.png").write_bytes(b"")
        write_videos(tmp_path / "cards" / name, ["GX01"], frames=2)
        (tmp_path / "cards" / name / "._GX01.mp4").write_bytes(b"")
    write_picture(tmp_path / "pictures" / "report" / "camera_a.png", picture(0, 0))
    pictures = find_footage(tmp_path / "pictures")
    assert pictures.cameras == ("a", "b")
    assert len(pictures.stamps("a")) == 1
    assert find_footage(tmp_path / "cards").files["a"].name == "GX01.mp4"


def test_a_file_of_another_kind_is_not_lost_unnoticed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_videos(tmp_path, ["a", "b"], frames=2)
    for name in ("c.DNG", "d.jpg", "notes.txt", "cameras.json"):
        (tmp_path / name).write_bytes(b"")
    with caplog.at_level(logging.WARNING):
        assert find_footage(tmp_path).cameras == ("a", "b")
    left = [record.getMessage().split(" is left out")[0].split("/")[-1] for record in caplog.records]
    assert left == ["c.DNG", "d.jpg"]
    assert "c.DNG is left out: it is not of the kind of" in caplog.text


def test_the_folder_above_the_videos(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_videos(tmp_path / "take", ["a", "b", "c"], frames=2)
    assert find_footage(tmp_path).files["b"] == tmp_path / "take/b.mp4"
    (tmp_path / "take").rename(tmp_path / "videos")
    write_picture(tmp_path / "plan.png", picture(0, 0))
    write_videos(tmp_path, ["preview"], frames=2)
    assert find_footage(tmp_path).files["b"] == tmp_path / "videos/b.mp4"
    assert "preview.mp4 is left out: the cameras are those of" in caplog.text
    caplog.clear()


def test_stills_beside_the_take_are_left_out_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_videos(tmp_path / "videos", ["a", "b"], frames=2)
    for name in "ab":
        write_picture(tmp_path / "images" / name / "0.png", picture(0, 0))
    with caplog.at_level(logging.WARNING):
        assert find_footage(tmp_path).files["a"] == tmp_path / "videos" / "a.mp4"
    assert "one picture of each camera" in caplog.text


def test_cards_that_were_copied_whole(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_videos(tmp_path / name / "DCIM/100GOPRO", ["GX010001"], frames=2)
    assert find_footage(tmp_path).files["b"] == tmp_path / "b/DCIM/100GOPRO/GX010001.mp4"


def test_links_beside_what_they_lead_to(tmp_path: Path) -> None:
    write_videos(tmp_path / "store", ["a", "b"], frames=2)
    for name in ("a", "b"):
        (tmp_path / f"{name}.mp4").symlink_to(tmp_path / "store" / f"{name}.mp4")
    assert find_footage(tmp_path).cameras == ("a", "b")


def test_pictures_of_one_moment_by_the_clocks(tmp_path: Path) -> None:
    write_videos(tmp_path, ["a", "b"], frames=10)
    footage = find_footage(tmp_path)
    clocks = {"b": Clock(-3 / 30)}
    first, last = shared_seconds(footage, clocks)
    assert (first, last) == pytest.approx((0.0, 6 / 30))
    shots = shots_of(footage, clocks, spread_moments(first, last, 3))
    assert [numbers(image)[1] for image in shots["a"]] == [0, 3, 6]
    assert [numbers(image)[1] for image in shots["b"]] == [3, 6, 9]
    assert numbers(shots["b"][1])[1] == 6


def test_videos_shorter_than_the_offset_are_reported(tmp_path: Path) -> None:
    write_videos(tmp_path, ["a", "b"], frames=10)
    footage = find_footage(tmp_path)
    with pytest.raises(
        CaptureError, match=r"a\.mp4 of camera 'a' ends .* before b\.mp4 of camera 'b' begins.*--without"
    ):
        shared_seconds(footage, {"b": Clock(2.0)})
