# SPDX-License-Identifier: Apache-2.0
"""Ghosts: content that is still drawn at a place that it has left.

Note [Ghosts]
~~~~~~~~~~~~~
The truth alone determines where a ghost may be: pixels that an object *occupied*, in difference to the median of the
pictures, and that are *disoccluded* now. Such a pixel is a *ghost* if the rendering is wrong there and was not wrong
before; where nothing was visible before, the error must contain a part of the object's colour. ``docs/evaluation.md``
has the definition with its numbers. Ghosts into which no small square fits are left out, because they are slightly
displaced outlines. Large pictures are reduced first, so that size does not change the score.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from structgstream.data.source import FrameSource, every_nth_frame, section
from structgstream.evaluation.metrics import Mask, Picture, blackened, differing, dilate, psnr
from structgstream.evaluation.pictures import block_mask, block_means

OCCUPIED, RESTORED, WRONG = 20, 8, 8  # levels of 255; noise of cameras and compression is 2 to 4 after the 3x3 mean
REACH, MARGIN = 12 / 640, 6 / 640  # shares of the longer side: soft edges, and shadows next to moving objects
SPECK = 2 / 640  # half the width of the smallest ghost; thinner ones are displaced outlines
SIDE = 640  # pixels of the longer side that a reduced picture has at least
RESIDUAL = 0.25  # of the difference between what was there and the truth
MEMORY_SECONDS, MEMORY_FRAMES = 2.0, 12
SECTION_SECONDS, SECTION_FRAMES = 10.0, 60
SAMPLES = 15  # pictures of a median
NEVER = -(10**9)


@dataclass(frozen=True)
class Ghosts:
    """The ghosts of one picture."""

    disoccluded: Mask  # [h, w] mask of the disoccluded pixels of the reduced picture
    ghosts: Mask  # [h, w] mask of the ghosts among them
    pixels: int  # number of pixels that count
    factor: int  # side of a pixel of these masks, in pixels of the picture
    psnr: float | None  # dB over the disoccluded pixels; None without any

    @property
    def disoccluded_share(self) -> float:
        """Disoccluded share of the pixels that count."""
        return int(np.count_nonzero(self.disoccluded)) / max(self.pixels, 1)

    @property
    def share(self) -> float | None:
        """Ghosts' share of the disoccluded pixels; None without any."""
        count = int(np.count_nonzero(self.disoccluded))
        return int(np.count_nonzero(self.ghosts)) / count if count else None


class GhostFinder:
    """Finds one camera's ghosts, frame by frame; its pictures are reduced. After ``memory`` frames an occupied pixel
    can no longer become a ghost."""

    def __init__(self, background: Picture, memory: int) -> None:
        shape = background.shape[:2]
        self.background, self.memory = background, memory
        # [h, w] number of the last frame in which the pixel, or one near it, was occupied
        self.occupied = np.full(shape, NEVER, np.int32)
        self.left = background  # truth of each pixel when it was last occupied; the background where it never was
        self.before = background  # rendering of each pixel when it was last not occupied
        self.seen = np.zeros(shape, np.bool_)  # [h, w] mask of the pixels with a value in before
        self.stuck = np.zeros(shape, np.bool_)  # [h, w] mask of the last picture's ghosts among the pixels of seen

    def replace_background(self, background: Picture) -> None:
        """Set another background; pixels where it differs from the last one are reset."""
        other = differing(background, self.background, RESTORED)
        self.occupied[other] = NEVER
        self.left = np.where(other[..., None], background, self.left)
        self.seen, self.stuck = self.seen & ~other, self.stuck & ~other
        self.background = background

    def find(self, picture: Picture, truth: Picture, *, index: int, mask: Mask | None = None) -> Ghosts:
        """The ghosts of the rendering ``[H, W, 3]`` of frame ``index`` in the pixels ``[H, W]`` that count; called in
        order of frames."""
        factor = reduction(truth)
        drawn, true = block_means(picture, factor), block_means(truth, factor)
        counting = None if mask is None else ~dilate(~block_mask(mask, factor), 1)
        there = differing(true, self.background, OCCUPIED)
        there = there if counting is None else there & counting
        near = dilate(there, pixels_of(REACH, true))
        recent = index - self.occupied <= self.memory
        free = ~dilate(there, pixels_of(MARGIN, true)) & ~differing(true, self.background, RESTORED)
        disoccluded = (recent | self.stuck) & (free if counting is None else free & counting)
        newly = np.where(self.seen, differing(drawn, self.before, WRONG), shows(self.left, drawn, true))
        ghosts = opened(disoccluded & differing(drawn, true, WRONG) & newly, pixels_of(SPECK, true))
        self.stuck = np.where(free, ghosts, self.stuck) & self.seen
        undisturbed = ~recent & ~near & ~self.stuck
        self.before = np.where(undisturbed[..., None], drawn, self.before)
        self.seen = self.seen | undisturbed
        self.occupied[near] = index
        self.left = np.where(there[..., None], true, self.left)
        pixels = there.size if counting is None else int(np.count_nonzero(counting))
        psnr_there = psnr(drawn, true, disoccluded) if disoccluded.any() else None
        return Ghosts(disoccluded, ghosts, pixels, factor, psnr_there)


def pixels_of(share: float, picture: Picture) -> int:
    """A share of the longer side of a picture ``[H, W, 3]`` in whole pixels, at least one."""
    return max(1, round(share * max(picture.shape[:2])))


def shows(thing: Picture, drawn: Picture, true: Picture) -> Mask:
    """Mask ``[H, W]`` where the error of ``drawn`` contains at least :data:`RESIDUAL` of the colour of ``thing``.

    All are ``[H, W, 3]``. The share is that of the error's projection onto the difference of thing and truth.
    """
    error, whole = (np.subtract(one, true, dtype=np.int16).astype(np.int32) for one in (drawn, thing))
    lengths = whole[..., 0] ** 2 + whole[..., 1] ** 2 + whole[..., 2] ** 2
    along = error[..., 0] * whole[..., 0] + error[..., 1] * whole[..., 1] + error[..., 2] * whole[..., 2]
    return (lengths > 3 * OCCUPIED**2) & (along >= RESIDUAL * lengths)


def opened(mask: Mask, pixels: int) -> Mask:
    """Morphological opening of ``mask`` ``[H, W]`` by a square that reaches ``pixels`` from its middle to each side."""
    return dilate(~dilate(~mask, pixels), pixels) & mask


def reduction(picture: Picture) -> int:
    """The whole factor by which a picture ``[H, W, 3]`` is reduced."""
    return max(1, max(picture.shape[:2]) // SIDE)


class GhostSearch:
    """The ghosts of several cameras over ``frames`` frames. The capture is read again for their backgrounds, section by
    section."""

    def __init__(self, source: FrameSource, names: tuple[str, ...], frames: int) -> None:
        self.source, self.names, self.frames = source, names, frames
        self.finders: dict[str, GhostFinder] = {}  # of the cameras whose background is known
        self.ends = 0  # number of the first frame of the next section

    def find(
        self, camera: str, picture: Picture, truth: Picture, *, index: int, mask: Mask | None = None
    ) -> Ghosts | None:
        """See :meth:`GhostFinder.find`; None for a camera without any picture so far."""
        if index >= self.ends:
            first, self.ends = next(one for one in sections(self.frames, self.source.fps) if one[1] > index)
            for name, background in backgrounds(self.source, self.names, first=first, end=self.ends).items():
                if name in self.finders:
                    self.finders[name].replace_background(background)
                else:
                    memory = max(round(MEMORY_SECONDS * self.source.fps), MEMORY_FRAMES)
                    self.finders[name] = GhostFinder(background, memory)
        finder = self.finders.get(camera)
        return None if finder is None else finder.find(picture, truth, index=index, mask=mask)


def sections(frames: int, fps: float) -> Iterator[tuple[int, int]]:
    """First frame and end of each section: equal parts of about ten seconds that have a background each."""
    length = max(round(SECTION_SECONDS * fps), SECTION_FRAMES)
    count = max(1, round(frames / length))
    for number in range(count):
        yield number * frames // count, (number + 1) * frames // count


def backgrounds(source: FrameSource, names: tuple[str, ...], *, first: int, end: int) -> Mapping[str, Picture]:
    """The reduced median picture of each camera over spread frames from ``first`` to ``end``; no absent cameras."""
    step = -(-(end - first) // SAMPLES)
    taken: dict[str, list[Picture]] = {}
    for frame in every_nth_frame(section(source, start=first, frames=end - first), step).frames():
        for name in frame.present(names):
            picture = blackened(frame.images[name], frame.masks.get(name))
            taken.setdefault(name, []).append(block_means(picture, reduction(picture)))
    return {name: np.median(np.stack(pictures), axis=0).astype(np.uint8) for name, pictures in taken.items()}
