# SPDX-License-Identifier: Apache-2.0
"""Masks beside captures: which pixels count, through resampling and undistortion, and what is refused."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unicodedata import normalize

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.data.images import reduced_mask
from structgstream.data.lenses import LensCamera, RadialTangential
from structgstream.data.masks import with_masks
from structgstream.data.open import open_capture
from structgstream.data.prepared import PreparedCamera, PreparedCapture, write_prepared
from structgstream.data.source import every_nth_frame
from structgstream.data.timeline import Clock
from structgstream.data.undistortion import Undistortion, rectilinear, undistort
from structgstream.errors import CaptureError
from tests.data.test_transforms_capture import write as write_transforms
from tests.support.captures import (
    HEIGHT,
    WIDTH,
    edit_json,
    picture,
    small_rig,
    write_clip,
    write_panoptic,
    write_picture,
    write_video,
    write_videos,
)

Mask = NDArray[np.bool_]


def write_mask(path: Path, mask: Mask) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), mask.astype(np.uint8) * 255)


def left_half(width: int = WIDTH, height: int = HEIGHT) -> Mask:
    return np.broadcast_to(np.arange(width) < width // 2, (height, width)).copy()


def test_one_mask_for_all_frames_and_one_for_each(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_panoptic(tmp_path, frames=3)
    top = left_half(HEIGHT, WIDTH).T
    write_mask(tmp_path / "masks/1.png", left_half())
    write_mask(tmp_path / "masks/2/000091.png", top)
    write_mask(tmp_path / "masks/3.png", left_half())
    write_mask(tmp_path / "masks/3/000092.png", top)
    frames = list(open_capture(tmp_path).frames())
    assert "what is black in the masks of cameras '1', '2', '3' does not count" in caplog.text
    for frame in frames:
        assert list(frame.images) == ["0", "1", "2", "3"]
        np.testing.assert_array_equal(frame.masks["1"], left_half())
        assert ("2" in frame.masks) == (frame.index == 1)
        np.testing.assert_array_equal(frame.masks["3"], left_half() & top if frame.index == 2 else left_half())
    np.testing.assert_array_equal(frames[1].masks["2"], top)


def test_masks_of_videos_are_numbered_and_follow_sections_and_sizes(tmp_path: Path) -> None:
    write_clip(tmp_path, frames=5)
    mask = left_half()
    mask[10, 10] = False
    write_mask(tmp_path / "masks/cam01/000003.png", mask)
    whole = open_capture(tmp_path)
    assert [list(frame.masks) for frame in whole.frames()] == [[], [], [], ["cam01"], []]
    part = open_capture(tmp_path, start=2, scale=0.5)
    frame = list(part.frames())[1]
    expected = left_half(WIDTH // 2, HEIGHT // 2)
    expected[5, 5] = False  # one of its four pixels is left out
    np.testing.assert_array_equal(frame.masks["cam01"], expected)
    assert [list(frame.masks) for frame in every_nth_frame(whole, 3).frames()] == [[], ["cam01"]]


def test_masks_of_a_video_are_numbered_as_its_own_frames(tmp_path: Path) -> None:
    rig = write_clip(tmp_path, frames=4)
    write_videos(tmp_path, list(rig), frames=6)
    write_video(tmp_path / "cam01.mp4", [picture(1, frame) for frame in range(2, 6)], instants=range(2, 6))
    for name in rig:
        write_mask(tmp_path / f"masks/{name}/3.png", left_half())
    frames = list(open_capture(tmp_path).frames())  # from the instant 2 on
    assert [list(frame.masks) for frame in frames] == [[], ["cam00", "cam02", "cam03"], [], ["cam01"]]


@pytest.mark.parametrize(
    ("pattern", "timed"), [("images/CAM/FRAME.png", True), ("images/CAM/FRAME.png", False), ("FRAME/CAM.png", False)]
)
def test_masks_are_named_as_the_camera_s_own_pictures(tmp_path: Path, pattern: str, timed: bool) -> None:
    """Not by their times, nor as those of a camera with other padding; pictures of one name are of their folders."""
    write_transforms(tmp_path, pattern, w=WIDTH, h=HEIGHT)
    if not timed:
        edit_json(tmp_path / "transforms.json", lambda content: [frame.pop("time") for frame in content["frames"]])
        for file in (tmp_path / "images/cam02").glob("*.png"):
            file.rename(file.with_stem(f"00{file.stem}"))
    write_mask(tmp_path / "masks/cam00/0001.png", left_half())
    assert [list(frame.masks) for frame in open_capture(tmp_path).frames()] == [[], ["cam00"], []]


def test_a_decomposed_name_of_a_camera(tmp_path: Path) -> None:
    """As archives of macOS have it."""
    write_clip(tmp_path, frames=2)
    file, name = tmp_path / "cameras.json", normalize("NFD", "süd")
    file.write_text(file.read_text().replace("cam02", "süd"))
    (tmp_path / "cam02.mp4").rename(tmp_path / f"{name}.mp4")
    write_mask(tmp_path / f"masks/{name}.png", left_half())
    write_mask(tmp_path / f"masks/{name}/1.png", left_half(HEIGHT, WIDTH).T)
    assert [(~frame.masks["süd"]).mean() for frame in open_capture(tmp_path).frames()] == [0.5, 0.75]


@pytest.mark.parametrize(
    "stored",
    [
        lambda mask: mask.astype(np.uint8),
        lambda mask: mask.astype(np.uint16),
        lambda mask: mask.astype(np.uint16)[..., None].repeat(3, 2),
        lambda mask: np.dstack([np.full((HEIGHT, WIDTH, 3), 255, np.uint8), mask.astype(np.uint8) * 255]),
    ],
    ids=["0 and 1", "0 and 1 in 16 bits", "16 bits in colour", "alpha"],
)
def test_what_is_black_or_hidden_by_alpha_does_not_count(
    tmp_path: Path, stored: Callable[[Mask], NDArray[np.integer]]
) -> None:
    write_clip(tmp_path, frames=2)
    (tmp_path / "masks").mkdir()
    assert cv2.imwrite(str(tmp_path / "masks/cam01.png"), stored(left_half()))
    np.testing.assert_array_equal(next(open_capture(tmp_path).frames()).masks["cam01"], left_half())


def test_masks_of_no_frame_are_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_clip(tmp_path, frames=2)
    for number in (1, 2, 3):
        write_mask(tmp_path / f"masks/cam01/{number}.png", left_half())
    open_capture(tmp_path)
    assert "2 masks in" in caplog.text
    assert "are of no frame of the capture, such as 2.png" in caplog.text


@pytest.mark.parametrize("place", ["Masks/cam01.png", "masks/cam01.PNG"])
def test_capitals_do_not_matter_and_hidden_files_are_no_masks(tmp_path: Path, place: str) -> None:
    write_clip(tmp_path, frames=2)
    file = tmp_path / place
    write_mask(file, left_half())
    (file.parent / "._cam01.PNG").write_bytes(b"")
    (file.parent / ".thumbs").mkdir()
    np.testing.assert_array_equal(next(open_capture(tmp_path).frames()).masks["cam01"], left_half())


def test_masks_of_a_prepared_capture_are_named_as_the_cameras_pictures(tmp_path: Path) -> None:
    """Whose instants have no common name: clocks shift them."""
    cameras = {}
    for number, (name, camera) in enumerate(small_rig().cameras.items()):
        filmed = LensCamera(camera, RadialTangential(k1=-0.05))
        clock = Clock(1 / 30 if number == 1 else 0.0)
        cameras[name] = PreparedCamera(f"pictures/{name}", filmed, rectilinear(filmed), clock)
        for frame in range(1, 5):
            write_picture(tmp_path / "pictures" / name / f"{frame:03d}.png", picture(number, frame))
    write_prepared(tmp_path, PreparedCapture(cameras, 30.0, 0.25))
    write_mask(tmp_path / "masks/cam00/003.png", np.zeros((HEIGHT, WIDTH), bool))
    write_mask(tmp_path / "masks/cam01/003.png", np.zeros((HEIGHT, WIDTH), bool))
    frames = list(open_capture(tmp_path).frames())
    # Frame 0 has the pictures 002, and 001 of the late one.
    assert {(name, frame.index) for frame in frames for name in frame.masks} == {("cam00", 1), ("cam01", 2)}


@pytest.mark.parametrize("size", [(32, 24), (21, 17), (64, 48)])
def test_a_reduced_pixel_counts_if_all_that_it_is_made_of_counts(size: tuple[int, int]) -> None:
    mask = np.random.default_rng(0).random((HEIGHT, WIDTH)) > 0.03
    image = np.where(mask, 0.0, 1e6).astype(np.float32)
    touched = cv2.resize(image, size, interpolation=cv2.INTER_AREA) > 0
    np.testing.assert_array_equal(reduced_mask(mask, size), ~touched if size != (64, 48) else mask)


def filmed(width: int = 96, height: int = 72) -> LensCamera:
    camera = small_rig(3)["cam00"].resized(width, height)
    return LensCamera(camera, RadialTangential(-0.25, 0.08, 0.002, -0.001))


@pytest.mark.parametrize("size", [(96, 72), (60, 45), (150, 110)])
def test_masked_pixels_of_a_lens_have_no_influence_after_undistortion(size: tuple[int, int]) -> None:
    camera = filmed()
    plan = Undistortion(camera, rectilinear(camera, size=size))
    rng = np.random.default_rng(1)
    mask = np.ones((72, 96), bool)
    mask[20:40, 30:55] = mask[5, 80] = mask[:, 0] = False
    picture = rng.integers(0, 255, (72, 96, 3), dtype=np.uint8)
    other = np.where(mask[..., None], picture, rng.integers(0, 255, (72, 96, 3), dtype=np.uint8))
    counts = plan.mask(mask)
    np.testing.assert_array_equal(plan(picture)[counts], plan(other)[counts])
    assert 0.6 < counts.mean() < mask.mean()


def test_masks_lie_below_the_lenses_whatever_lies_above(tmp_path: Path) -> None:
    rig = write_clip(tmp_path, frames=2)
    write_mask(tmp_path / "others/cam02.png", left_half())
    lens = RadialTangential(-0.1)
    source = open_capture(tmp_path)
    made = undistort(source, {name: LensCamera(source.rig[name], lens) for name in rig})
    thinned = with_masks(every_nth_frame(made, 2), tmp_path / "others")
    expected = Undistortion(LensCamera(source.rig["cam02"], lens), made.rig["cam02"]).mask(left_half())
    np.testing.assert_array_equal(next(thinned.frames()).masks["cam02"], expected)


def test_a_mask_that_leaves_nothing_out_costs_nothing(tmp_path: Path) -> None:
    write_clip(tmp_path, frames=2)
    write_mask(tmp_path / "masks/cam01.png", np.ones((HEIGHT, WIDTH), bool))
    assert not next(open_capture(tmp_path).frames()).masks


def test_a_camera_of_which_nothing_counts_is_not_present(tmp_path: Path) -> None:
    write_clip(tmp_path, frames=2)
    write_mask(tmp_path / "masks/cam01.png", np.zeros((HEIGHT, WIDTH), bool))
    frame = next(open_capture(tmp_path).frames())
    assert frame.present(("cam00", "cam01", "cam02")) == ("cam00", "cam02")
    assert replace(frame, masks={}).present(("cam01",)) == ("cam01",)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "cam09.png",
            "cam09.png is a mask of camera 'cam09', which the capture .* does not have; its cameras are cam00",
        ),
        ("cam01/17.png", r"None of the masks in .*cam01 is of a frame of the capture, such as 17\.png; .* 000000\.png"),
        ("cam01/images/0.png", r"None of the masks in .*cam01 is of a frame .* such as images; .* 000000\.png"),
        ("cam01.jpg", r"cam01\.jpg is no PNG"),
        ("cam01.mp4", r"cam01\.mp4 is no PNG"),
    ],
)
def test_masks_that_do_not_belong_are_refused(tmp_path: Path, name: str, words: str) -> None:
    """By their names: they are not opened."""
    write_clip(tmp_path, frames=3)
    file = tmp_path / "masks" / name
    file.parent.mkdir(parents=True)
    file.touch()
    with pytest.raises(CaptureError, match=words):
        open_capture(tmp_path)


def test_masks_of_another_size_and_broken_ones_are_refused(tmp_path: Path) -> None:
    write_clip(tmp_path, frames=3)
    write_mask(tmp_path / "masks/cam01.png", left_half(32, 24))
    with pytest.raises(CaptureError, match=r"cam01\.png has 32x24 pixels, the pictures of camera 'cam01' have 64x48"):
        open_capture(tmp_path)
    (tmp_path / "masks/cam01.png").write_bytes(b"nothing")
    with pytest.raises(CaptureError, match=r"cam01\.png cannot be decoded"):
        open_capture(tmp_path)
