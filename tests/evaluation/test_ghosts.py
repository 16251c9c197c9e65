# SPDX-License-Identifier: Apache-2.0
"""Ghosts of a square that moves over a background and stays drawn where it was, or does not."""

import itertools
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.evaluation.ghosts import Ghosts, GhostSearch, backgrounds, sections
from structgstream.frames import MultiViewFrame
from tests.support.memory_captures import MemoryCapture
from tests.support.rigs import arc_rig

Picture = NDArray[np.uint8]
Drawing = Callable[[int], Picture]
CAMERA = "cam00"
FRAMES = 12
BACKGROUND, SQUARE = (90, 90, 90), (200, 60, 40)


def film(
    truth: Drawing,
    *,
    count: int = FRAMES,
    fps: float = 30.0,
    mask: NDArray[np.bool_] | None = None,
    absent: Collection[int] = (),
) -> MemoryCapture:
    """Pictures of one camera, which others never have."""
    height, width = truth(0).shape[:2]
    there = {index: {CAMERA: truth(index)} for index in range(count) if index not in absent}
    masks = {} if mask is None else {CAMERA: mask}
    frames = [MultiViewFrame(i, i / fps, there.get(i, {}), masks if i in there else {}) for i in range(count)]
    return MemoryCapture(arc_rig(3, width=width, height=height), frames, fps)


@dataclass(frozen=True)
class Scene:
    """A noisy background with a square; everything scales with ``size``.

    Args:
        size: of a unit: the picture is 80 x 60 units, the square 8.
        first: frame in which the square comes.
        speed: units a frame.
        residual: share of the square's colour that stays where it was.
        from_start: the rendering is brighter there than the truth all the time by this many levels.
        gone: frame from which on the square is away.
    """

    size: int = 4
    first: int = 0
    speed: int = 6
    residual: float = 0.0
    from_start: int = 0
    gone: int = FRAMES

    def truth(self, index: int) -> Picture:
        """With noise, of another kind in each frame."""
        return np.roll(_noise(self.size), 7 * index, axis=1) + self._scene([index])

    def rendering(self, index: int) -> Picture:
        """The truth without noise, and all places before as ghosts."""
        drawn = self._scene([index])
        if self.residual:
            trail = self.square(range(index)) & ~self.square([index])
            drawn[trail] = np.rint((1 - self.residual) * np.array(BACKGROUND) + self.residual * np.array(SQUARE))
        return drawn + np.uint8(self.from_start)

    def square(self, indices: Iterable[int]) -> NDArray[np.bool_]:
        """Where it is in any of these frames, ``[H, W]``."""
        where = np.zeros((60 * self.size, 80 * self.size), np.bool_)
        for index in indices:
            if self.first <= index < self.gone:
                left = (2 + self.speed * (index - self.first)) * self.size
                where[20 * self.size : 28 * self.size, left : left + 8 * self.size] = True
        return where

    def _scene(self, indices: Iterable[int]) -> Picture:
        picture = np.full((60 * self.size, 80 * self.size, 3), BACKGROUND, np.uint8)
        picture[self.square(indices)] = SQUARE
        return picture


@cache
def _noise(size: int) -> Picture:
    """Of two levels to each side, modulo 256."""
    return np.random.default_rng(0).integers(-2, 3, (60 * size, 80 * size, 3)).astype(np.uint8)


def found(scene: Scene, capture: MemoryCapture | None = None) -> list[Ghosts | None]:
    """What is found, frame by frame."""
    capture = film(scene.truth) if capture is None else capture
    search = GhostSearch(capture, (CAMERA,), len(capture))
    return [
        search.find(
            CAMERA, scene.rendering(frame.index), frame.images[CAMERA], index=frame.index, mask=frame.masks.get(CAMERA)
        )
        for frame in capture.frames()
        if frame.images
    ]


def ghost_pixels(ghosts: list[Ghosts | None]) -> list[int]:
    return [0 if one is None else int(np.count_nonzero(one.ghosts)) for one in ghosts]


def test_a_square_that_leaves_nothing_behind_has_no_ghosts() -> None:
    ghosts = found(Scene())
    assert ghost_pixels(ghosts) == [0] * FRAMES
    assert ghosts[0].share is None
    assert ghosts[0].psnr is None
    assert all(one is not None and one.share == 0.0 and one.psnr is not None and one.psnr > 40 for one in ghosts[1:])


@pytest.mark.parametrize("first", [0, 3])
def test_a_place_that_stays_drawn_is_a_ghost(first: int) -> None:
    """Also that of frame 0, of which nobody knows what was there before."""
    scene = Scene(first=first, residual=0.5)
    ghosts = found(scene)
    assert ghost_pixels(ghosts)[: first + 1] == [0] * (first + 1)
    area = (8 * scene.size) ** 2
    for index, one in enumerate(ghosts[first + 1 :], first + 1):
        places = scene.square(range(index)) & ~scene.square([index])
        assert one.ghosts[places].mean() > 0.8  # all but what is near the square now
        assert np.count_nonzero(one.ghosts & ~places) < 0.2 * places.sum()
        assert np.count_nonzero(one.ghosts) > 0.4 * area
        assert one.share > 0.2
        assert one.psnr < 25


def test_a_weak_residual_is_below_the_threshold() -> None:
    weak, strong = (sum(ghost_pixels(found(Scene(residual=residual)))) for residual in (0.05, 0.3))
    assert weak == 0 < strong


def test_what_was_wrong_all_along_is_no_ghost() -> None:
    """Where something stood in frame 0, too, of which nobody knows what was drawn behind it."""
    for first in (0, 3):
        ghosts = found(Scene(first=first, from_start=12))
        assert ghost_pixels(ghosts) == [0] * FRAMES
        assert all(one is not None and one.psnr is not None and one.psnr < 30 for one in ghosts[first + 1 :])


@pytest.mark.parametrize("size", [2, 4, 16])
def test_the_score_does_not_depend_on_the_size_of_the_pictures(size: int) -> None:
    """From 160 to 1280 pixels, of which the largest are reduced."""
    ghosts = found(Scene(size=size, residual=0.5))
    assert {one.factor for one in ghosts if one} == {max(1, 80 * size // 640)}
    reference = found(Scene(size=4, residual=0.5))
    for one, other in zip(ghosts[1:], reference[1:], strict=True):
        assert one.disoccluded_share == pytest.approx(other.disoccluded_share, rel=0.12)
        assert one.share == pytest.approx(other.share, rel=0.25)


def test_a_ghost_counts_as_long_as_it_stays_and_its_place_two_seconds() -> None:
    """Of 20 frames, at 4 a second, of which 12 are remembered."""
    for residual in (0.0, 0.5):
        scene = Scene(first=1, gone=3, residual=residual)
        ghosts = found(scene, film(scene.truth, count=20, fps=4.0))
        shares = [0.0 if one is None else one.disoccluded_share for one in ghosts]
        assert all(shares[3:15])
        assert bool(shares[19]) == bool(ghost_pixels(ghosts)[19]) == bool(residual)


def test_masked_pixels_have_no_ghosts() -> None:
    scene = Scene(residual=0.5)
    mask = np.zeros((240, 320), np.bool_)
    mask[:, 160:] = True
    ghosts = found(scene, film(scene.truth, mask=mask))
    assert max(ghost_pixels(ghosts)) > 0
    for one in ghosts:
        assert not one.ghosts[:, :160].any()
        assert not one.disoccluded[:, :160].any()
        assert one.pixels <= 240 * 160


def test_an_absent_camera_is_skipped_and_one_that_is_never_there_has_no_score() -> None:
    scene = Scene(residual=0.5)
    ghosts = found(scene, film(scene.truth, absent={4, 5}))
    assert len(ghosts) == FRAMES - 2
    assert ghost_pixels(ghosts)[-1] > 0
    search = GhostSearch(film(scene.truth), (CAMERA, "cam01"), FRAMES)
    assert search.find("cam01", scene.truth(0), scene.truth(0), index=0) is None


def test_backgrounds_are_medians_of_few_pictures_and_sections_cover_all_frames() -> None:
    scene = Scene()
    capture = film(lambda index: scene.truth(index) if 40 <= index < 100 else np.zeros_like(scene.truth(0)), count=200)
    (background,) = backgrounds(capture, (CAMERA,), first=40, end=100).values()
    assert np.abs(background.astype(int) - 90).max() <= 2
    for frames, fps in ((1, 30.0), (12, 30.0), (299, 30.0), (1000, 25.0), (77, 1.0)):
        parts = list(sections(frames, fps))
        assert parts[0][0] == 0
        assert parts[-1][1] == frames
        assert all(one[1] == other[0] for one, other in itertools.pairwise(parts))
        assert max(end - first for first, end in parts) <= 1.5 * max(10 * fps, 60)


def test_another_background_is_not_something_that_left() -> None:
    """A lamp is switched between two sections: nothing was there before, so nothing is a ghost."""
    dark = Scene(first=99)

    def truth(index: int) -> Picture:
        return dark.truth(index) + np.uint8(60 if index >= 60 else 0)

    search = GhostSearch(film(truth, count=120, fps=6.0), (CAMERA,), 120)
    ghosts = [search.find(CAMERA, dark.rendering(i), truth(i), index=i) for i in range(120)]
    assert ghost_pixels(ghosts) == [0] * 120
