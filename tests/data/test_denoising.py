# SPDX-License-Identifier: Apache-2.0
"""Means over frames of what stands still: less noise there, every bit of what moves."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from structgstream import cameras
from structgstream.data.denoising import MAX_FRAMES, Denoised, DenoisingConfig, denoised, mean_of_still
from structgstream.data.source import FrameSource, Prefetch, section
from structgstream.errors import CaptureError, ConfigError
from structgstream.frames import MultiViewFrame
from tests.support.memory_captures import MemoryCapture
from tests.support.rigs import arc_rig
from tests.support.varied import varied

HEIGHT, WIDTH, FRAMES = 48, 64, 12
EIGHT = DenoisingConfig(frames=8)
RIG = arc_rig(3, width=WIDTH, height=HEIGHT)  # cam00 is held out
TRUTH = {
    name: np.random.default_rng(number).integers(40, 216, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    for number, name in enumerate(RIG)
}
NOISE = 3.0


def noisy(index: int, name: str, *, block_at: int | None = None) -> np.ndarray:
    """The truth with the noise of this camera and frame; a white block of 12 pixels begins at a column."""
    picture = TRUTH[name].astype(float)
    if block_at is not None:
        picture[18:30, block_at : block_at + 12] = 250.0
    found = picture + np.random.default_rng([index, *name.encode()]).normal(0.0, NOISE, picture.shape)
    return found.round().clip(0, 255).astype(np.uint8)


def film(frames: int = FRAMES, *, block: Callable[[int], int | None] = lambda index: None) -> list[MultiViewFrame]:
    return [
        MultiViewFrame(index, index / 30, {name: noisy(index, name, block_at=block(index)) for name in RIG})
        for index in range(frames)
    ]


def capture(frames: Sequence[MultiViewFrame]) -> FrameSource:
    return MemoryCapture(RIG, frames)


def error(image: np.ndarray, name: str, *, columns: slice = slice(None)) -> float:
    return float((image.astype(float) - TRUTH[name])[:, columns].std())


def test_the_mean_of_eight_still_pictures_has_a_third_of_the_noise() -> None:
    frames = film()
    found = next(denoised(capture(frames), EIGHT).frames())
    assert found.mean_of == 8.0
    for name in RIG.training:
        assert error(frames[0].images[name], name) == pytest.approx(NOISE, rel=0.05)
        assert error(found.images[name], name) == pytest.approx(NOISE / 8**0.5, rel=0.1)  # with the rounding's 0.29
    assert found.images["cam00"] is frames[0].images["cam00"], "nothing is made of what is held out"


def test_what_moves_keeps_its_picture_and_what_is_far_from_it_is_averaged() -> None:
    frames = film(block=lambda index: 10 + 2 * index)
    found = next(denoised(capture(frames), EIGHT).frames())
    for name in RIG.training:
        before, after = frames[0].images[name], found.images[name]
        assert np.array_equal(after[18:30, 12:22], before[18:30, 12:22]), "the block's pixels that change at once"
        assert error(after, name, columns=slice(48, None)) < NOISE / 2
    assert 1.0 < found.mean_of < 8.0


def test_what_has_changed_is_not_averaged_when_it_looks_the_same_again() -> None:
    frames = film(block=lambda index: 20 if index == 1 else None)
    found = next(denoised(capture(frames), EIGHT).frames())
    before = frames[0].images["cam01"]
    assert np.array_equal(found.images["cam01"][18:30, 20:32], before[18:30, 20:32])


def test_light_that_changes_at_once_is_not_averaged() -> None:
    dark = film(1)[0]
    bright = MultiViewFrame(1, 1 / 30, {name: image + np.uint8(30) for name, image in dark.images.items()})
    found = next(denoised(capture([dark, bright]), EIGHT).frames())
    assert found.mean_of == 1.0
    assert all(np.array_equal(found.images[name], dark.images[name]) for name in RIG)


def test_equal_pictures_keep_every_bit() -> None:
    """Of a capture that ends before eight frames."""
    first = film(1)[0]
    frames = [replace(first, index=index) for index in range(5)]
    found = next(denoised(capture(frames), EIGHT).frames())
    assert found.mean_of == 5.0
    assert all(np.array_equal(found.images[name], first.images[name]) for name in RIG)


def test_an_absent_camera_ends_its_mean_only() -> None:
    frames = film()
    frames[3] = replace(frames[3], images={name: frames[3].images[name] for name in ("cam02", "cam00")})
    found = next(denoised(capture(frames), EIGHT).frames())
    assert found.mean_of == (3.0 + 8.0) / 2
    assert error(found.images["cam01"], "cam01") == pytest.approx(NOISE / 3**0.5, rel=0.1)


def test_masked_pixels_are_not_averaged() -> None:
    frames, mask = film(), np.ones((HEIGHT, WIDTH), bool)
    mask[:, :20] = False
    frames[0] = replace(frames[0], masks={"cam01": mask})
    frames[4] = replace(frames[4], masks={"cam02": mask})
    found = next(denoised(capture(frames), EIGHT).frames())
    assert np.array_equal(found.images["cam01"][:, :20], frames[0].images["cam01"][:, :20])
    averaged = found.images["cam02"]
    assert error(averaged, "cam02", columns=slice(20)) == pytest.approx(NOISE / 4**0.5, rel=0.1)
    assert error(averaged, "cam02", columns=slice(20, None)) == pytest.approx(NOISE / 8**0.5, rel=0.1)


def test_other_frames_are_untouched_and_do_not_depend_on_where_reading_begins() -> None:
    frames = film(block=lambda index: 10 + 2 * index)
    source = Denoised(capture(frames), EIGHT, (0, 5))
    found = list(source.frames())
    assert [frame.index for frame in found] == list(range(FRAMES))
    for index in {*range(FRAMES)} - {0, 5}:
        assert found[index] is frames[index]
    for start in range(FRAMES):
        again = next(source.frames(start))
        assert all(np.array_equal(again.images[name], found[start].images[name]) for name in RIG)
    assert found[5].mean_of > 1.0
    assert len(source) == FRAMES


def test_what_flickers_behind_a_mask_does_not_keep_its_surroundings_from_being_averaged() -> None:
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[10:30, 20:40] = False
    found = []
    for seed in (None, 1, 2):
        frames = film()
        if seed is not None:
            rng = np.random.default_rng(seed)
            frames = [
                replace(
                    frame,
                    images={
                        name: np.where(mask[..., None], image, rng.integers(0, 256, image.shape)).astype(np.uint8)
                        for name, image in frame.images.items()
                    },
                )
                for frame in frames
            ]
        masks = dict.fromkeys(RIG, mask)
        found.append(next(denoised(capture([replace(f, masks=masks) for f in frames]), EIGHT).frames()))
    for name in RIG.training:
        assert all(np.array_equal(one.images[name][mask], found[0].images[name][mask]) for one in found)
        assert error(found[0].images[name], name, columns=slice(41, None)) < NOISE / 2


@pytest.mark.parametrize("ahead", [False, True])
def test_the_first_frame_alone_is_that_of_the_whole_capture(ahead: bool) -> None:
    """So that groups share the header of a sequential run (docs/cluster.md)."""
    whole = capture(film())
    cut = section(whole, start=2, frames=1)
    (found,) = denoised(Prefetch(cut) if ahead else cut, EIGHT).frames()
    expected = next(denoised(section(whole, start=2), EIGHT).frames())
    assert found.mean_of == expected.mean_of == 8.0
    assert all(np.array_equal(found.images[name], expected.images[name]) for name in RIG)


def test_a_frame_that_cannot_be_read_ends_the_mean_and_is_reported_when_it_is_its_turn() -> None:
    class Broken(MemoryCapture):
        def frames(self, start: int = 0):
            for frame in super().frames(start):
                if frame.index == 4:
                    raise CaptureError("frame 4 cannot be read")
                yield frame

    frames = denoised(Broken(RIG, film()), EIGHT).frames()
    assert next(frames).mean_of == 4.0
    assert [next(frames).index for _ in range(3)] == [1, 2, 3]
    with pytest.raises(CaptureError, match="frame 4"):
        next(frames)
    (alone,) = denoised(section(Broken(RIG, film()), frames=1), EIGHT).frames()
    assert alone.mean_of == 4.0


def test_one_frame_and_live_cameras_are_the_source_itself() -> None:
    class Live:
        rig, fps, name, points = RIG, 30.0, "live", None

        def frames(self, start: int = 0):
            return iter(film()[start:])

    source, live = capture(film()), Live()
    assert denoised(source, DenoisingConfig()) is source
    assert denoised(live, EIGHT) is live


def test_means_are_rounded_to_the_nearest() -> None:
    first = MultiViewFrame(0, 0.0, {"cam01": np.full((8, 8, 3), 100, np.uint8)})
    others = [
        MultiViewFrame(n, n / 30, {"cam01": np.full((8, 8, 3), value, np.uint8)}) for n, value in ((1, 101), (2, 102))
    ]
    (image,) = mean_of_still(first, others, names=("cam01",), config=DenoisingConfig(frames=2)).images.values()
    assert (image == 101).all(), "100.5"
    (image,) = mean_of_still(first, others, names=("cam01",), config=DenoisingConfig(frames=3)).images.values()
    assert (image == 101).all()


def test_the_largest_sums_fit() -> None:
    white = MultiViewFrame(0, 0.0, {"cam01": np.full((8, 8, 3), 255, np.uint8)})
    config = DenoisingConfig(frames=MAX_FRAMES)
    found = mean_of_still(white, [white] * MAX_FRAMES, names=("cam01",), config=config)
    assert found.mean_of == MAX_FRAMES
    assert (found.images["cam01"] == 255).all()


@pytest.mark.parametrize("frames", [0, MAX_FRAMES + 1])
def test_what_cannot_be_is_refused(frames: int) -> None:
    with pytest.raises(ConfigError, match="Denoising takes"):
        DenoisingConfig(frames=frames)


def test_the_surroundings_that_have_to_stand_still_are_as_wide_in_larger_pictures(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A block moves by eight of 64 pixels; the strip beside it that is not averaged is as wide in twice the size."""

    def averaged(times: int) -> np.ndarray:
        frames = [picture.repeat(times, 0).repeat(times, 1) for picture in (flat(10), flat(18))]
        first, later = (MultiViewFrame(number, 0.0, {"cam01": picture}) for number, picture in enumerate(frames))
        monkeypatch.setattr(cameras, "REFERENCE_PIXELS", WIDTH)
        found = mean_of_still(first, [later], names=["cam01"], config=varied(DenoisingConfig(frames=2), REACH_PIXELS=6))
        return found.images["cam01"][::times, ::times, 0] != frames[0][::times, ::times, 0]

    def flat(column: int) -> np.ndarray:
        picture = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
        picture[18:30, column : column + 12] = 250
        return picture + np.uint8(2 if column > 10 else 0)  # What is averaged shows it.

    small, large = averaged(1), averaged(2)
    assert 0.3 < small.mean() < 0.9
    assert (small != large).mean() < 0.05
