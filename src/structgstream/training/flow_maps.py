# SPDX-License-Identifier: Apache-2.0
"""Optical flow of a training camera as maps to be summed by blending weights."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.errors import ConfigError, MissingExtraError
from structgstream.flow import ABSOLUTE, RELATIVE, dis_search
from structgstream.kernels.backend import Backend
from structgstream.training.views import area_mean

CONTEXT_PIXELS = 16
"""Margin in pixels around the bounding box of the changed pixels, in which flow is estimated."""
LEAST_SAVING = 0.8
"""Boxes around parts have to be together smaller than this share of the box around all."""


@dataclass(frozen=True)
class FlowConfig:
    """How finely flow is searched (``flow.dis_search``)."""

    finest_level: int = 1
    """Of the search's pyramid: 0 is the size of the pictures, 1 half of it."""
    least_width: int = 240
    """Where the finest level would be narrower than this, pixels, a finer one is searched: in small pictures what moves
    is small, too."""
    apart: bool = False
    """Search in a box for each part of a picture that changed, instead of one around all: quicker where things move far
    from each other."""

    def __post_init__(self) -> None:
        if self.finest_level < 0 or self.least_width < 0:
            raise ConfigError(
                f"online.start.flow has finest level {self.finest_level} and least width {self.least_width}; "
                "expected neither below 0."
            )

    def level_of(self, width: int) -> int:
        """The finest level for pictures ``width`` pixels wide."""
        level = self.finest_level
        while level > 0 and width >> level < self.least_width:
            level -= 1
        return level


USUAL_FLOW = FlowConfig()


def flow_map(
    first: Tensor,
    second: Tensor,
    changed: Tensor,
    size: tuple[int, int],
    *,
    mask: Tensor | None = None,
    config: FlowConfig,
    backend: Backend,
) -> Tensor:
    """Flow between two pictures of one camera with confidence c: ``[h, w, 3]``, the maps (c, c flow_x, c flow_y).

    c is the share of consistent pixels (``kernels.operations.ConfidentFlow``), zero outside a box around ``changed``,
    or with ``config.apart`` outside boxes around its parts, where these are small.

    Args:
        first: ``[H, W, 3]`` uint8.
        second: ``[H, W, 3]`` uint8.
        changed: ``[H, W]`` bool, where the two differ.
        size: h and w of the maps; flow is in pixels of the pictures.
        mask: ``[H, W]`` bool, pixels that may have confidence; None for all.
        config: of the search.
        backend: the compute back-end.
    """
    maps = torch.zeros(3, *changed.shape)
    search = dis_search("capture", refined=False, finest_level=config.level_of(changed.shape[1]))
    where = changed.numpy(force=True)
    for rows, columns in _boxes(where) if config.apart else _box(where):
        earlier, later = (np.ascontiguousarray(p[rows, columns].numpy(force=True)) for p in (first, second))
        forward, back = (torch.from_numpy(search(*pair)) for pair in ((earlier, later), (later, earlier)))
        counts = None if mask is None else mask[rows, columns].cpu()
        maps[:, rows, columns] = backend.confident_flow(forward, back, counts, relative=RELATIVE, absolute=ABSOLUTE)
    return area_mean(maps[None], size)[0].permute(1, 2, 0).to(first.device)


Box = tuple[slice, slice]
Mask = NDArray[np.bool_]


def _box(mask: Mask) -> list[Box]:
    """Bounding box of the mask ``[H, W]`` with margin; none if it is empty or too small for the flow search."""
    if not mask.any():
        return []
    spans = []
    for axis in (1, 0):
        hit = np.flatnonzero(mask.any(axis))
        low, high = int(hit[0]) - CONTEXT_PIXELS, int(hit[-1]) + 1 + CONTEXT_PIXELS
        spans.append(slice(max(0, low), min(mask.shape[1 - axis], high)))
    if min(span.stop - span.start for span in spans) < 2 * CONTEXT_PIXELS:
        return []
    return [(spans[0], spans[1])]


def _boxes(mask: Mask) -> list[Box]:
    """Disjoint boxes with margin around the parts of the mask ``[H, W]``; one around all if that is hardly larger."""
    one = _box(mask)
    rows, columns = (-(-length // CONTEXT_PIXELS) for length in mask.shape)
    padded = np.zeros((rows * CONTEXT_PIXELS, columns * CONTEXT_PIXELS), bool)
    padded[: mask.shape[0], : mask.shape[1]] = mask
    # First down the columns, whose steps are long: NumPy takes ten times as long for both at once.
    high = padded.reshape(rows, CONTEXT_PIXELS, -1).any(1)
    cells = np.logical_or.reduce(high.reshape(rows, columns, CONTEXT_PIXELS), axis=2)
    found = [_pixels(box, mask) for box in _parts(cells)]
    if not one or sum(map(_area, found)) > LEAST_SAVING * _area(one[0]):
        return one
    return [box for box in found if min(span.stop - span.start for span in box) >= 2 * CONTEXT_PIXELS]


def _parts(cells: Mask) -> list[tuple[int, int, int, int]]:
    """Disjoint boxes (first and end row, first and end column) around the connected parts of ``cells`` and the eight
    cells around each."""
    try:
        import cv2
    except ImportError:
        raise MissingExtraError("cv2", "capture") from None
    grown = cv2.dilate(cells.astype(np.uint8), np.ones((3, 3), np.uint8))
    _, _, stats, _ = cv2.connectedComponentsWithStats(grown, connectivity=8)
    boxes = np.asarray(stats)[1:, :4].tolist()  # The first is what is no part.
    left = [(top, top + height, first, first + width) for first, top, width, height in boxes]
    done: list[tuple[int, int, int, int]] = []
    while left:
        box = left.pop()
        hit = [other for other in done if _overlap(box, other)]
        if not hit:
            done.append(box)
            continue
        done = [other for other in done if other not in hit]
        together = np.array([box, *hit])
        low, high = together.min(0), together.max(0)
        left.append((int(low[0]), int(high[1]), int(low[2]), int(high[3])))
    return sorted(done)


def _overlap(one: tuple[int, int, int, int], other: tuple[int, int, int, int]) -> bool:
    return one[0] < other[1] and other[0] < one[1] and one[2] < other[3] and other[2] < one[3]


def _pixels(box: tuple[int, int, int, int], mask: Mask) -> Box:
    top, bottom, left, right = (CONTEXT_PIXELS * edge for edge in box)
    return slice(top, min(bottom, mask.shape[0])), slice(left, min(right, mask.shape[1]))


def _area(box: Box) -> int:
    rows, columns = box
    return (rows.stop - rows.start) * (columns.stop - columns.start)
