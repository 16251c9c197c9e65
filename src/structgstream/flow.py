# SPDX-License-Identifier: Apache-2.0
"""Optical flow between two pictures of one camera, and its forward-backward consistency.

Dense inverse search (:func:`dis_search`) is accurate, but loses objects that move farther than their own size: they are
not visible at the levels of the pyramid where their motion is short. :func:`block_search` searches all displacements up
to a bound on reduced pictures, and :func:`dis_refinement` refines its result.
"""

from collections.abc import Callable
from math import hypot
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from structgstream.errors import import_extra

RELATIVE, ABSOLUTE = 0.01, 0.5  # thresholds of the consistency check: share of squared lengths; squared pixels

FlowSearch = Callable[[NDArray[np.uint8], NDArray[np.uint8]], NDArray[np.float32]]
"""From two pictures ``[H, W, 3]`` of one size to flow ``[H, W, 2]``, x and y in pixels: pixel ``p`` of the first
picture corresponds to ``p + flow[p]`` in the second."""


FlowRefinement = Callable[[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32]], NDArray[np.float32]]
"""As :data:`FlowSearch`, with an approximate initial flow ``[H, W, 2]``."""

BLOCK_COST_CLIP = 300.0
"""Largest difference of two cells, in levels of 255 summed over channels; larger differences are clamped to it."""
BLOCK_COST_PER_CELL = 0.6
"""Cost of a displacement by one cell, in the same levels, which decides in untextured regions."""


COLOR_DIFFERENCE = 20
"""Mean difference of colours, in levels of 255, that inexact flow leaves at edges."""
UNEXPLAINED_SHARE = 0.8
"""Share of the difference without flow that flow may leave: of reflections, and of what turns."""
LIGHT_STRIDE = 4
"""Every so many rows and columns a pixel is taken for the median change of light."""


def dis_search(extra: str, *, refined: bool = True, finest_level: int = 1) -> FlowSearch:
    """Flow by dense inverse search (Kroeger et al., 2016) on grey pictures.

    Args:
        extra: the extra of this package that a user should install when OpenCV is missing.
        refined: OpenCV's preset "medium". False: preset "fast" down to ``finest_level``, without variational
            refinement; at half resolution it takes two fifths of the time and is as accurate at consistent pixels
            (:func:`consistency_mask`).
        finest_level: finest level of the pyramid, if not refined: 1 is half resolution, 0 full.

    Raises:
        MissingExtraError: OpenCV is not installed.
    """
    cv2 = opencv(extra)
    preset = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM if refined else cv2.DISOPTICAL_FLOW_PRESET_FAST
    search = cv2.DISOpticalFlow.create(preset)
    if not refined:
        search.setFinestScale(finest_level)
        search.setVariationalRefinementIterations(0)

    def flow(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.float32]:
        one, other = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (first, second))
        # calc starts from its argument and overwrites it.
        return np.asarray(search.calc(one, other, np.zeros((*one.shape, 2), np.float32)), np.float32)

    return flow


def dis_refinement(*, finest_level: int, coarsest_level: int) -> FlowRefinement:
    """As :func:`dis_search` with ``refined=False``, but starts from an approximate flow at level ``coarsest_level``.
    Raises MissingExtraError if OpenCV is not installed."""
    cv2 = opencv("capture")
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    search.setFinestScale(finest_level)
    search.setCoarsestScale(coarsest_level)
    search.setVariationalRefinementIterations(0)

    def flow(first: NDArray[np.uint8], second: NDArray[np.uint8], start: NDArray[np.float32]) -> NDArray[np.float32]:
        one, other = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (first, second))
        return np.asarray(search.calc(one, other, start.copy()), np.float32)

    return flow


def block_search(
    first: NDArray[np.uint8], second: NDArray[np.uint8], *, cell_pixels: int, reach_cells: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Approximate flow ``[H, W, 2]``, pixels, from ``first`` to ``second`` ``[H, W, 3]`` and back: block matching.

    A cell is ``cell_pixels`` wide, a pixel of the reduced pictures. For each cell p the displacement s of at most
    ``reach_cells`` cells with the least cost is chosen. The cost is ``min(sum_c |first(p) - second(p + s)|, 300)``,
    averaged over 3 x 3 cells, plus ``0.6 |s|``. The result is the median over 3 x 3 cells, enlarged. The time is that
    of ``pi reach_cells^2`` passes over the cells.

    Raises:
        MissingExtraError: OpenCV is not installed.
    """
    cv2 = opencv("capture")
    height, width = first.shape[:2]
    columns, rows = -(-width // cell_pixels), -(-height // cell_pixels)
    one, other = (
        cv2.resize(picture, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float32)
        for picture in (first, second)
    )
    displacements = _displacements(reach_cells, columns, rows)
    least = [np.full((rows, columns), np.inf, np.float32) for _ in range(2)]
    best = [np.zeros((rows, columns), np.int16) for _ in range(2)]
    total = np.ones((1, 3), np.float32)
    for number, (dx, dy) in enumerate(displacements):
        # The cells of the first picture that stay inside when displaced, and the cells of the second that they map to.
        here = slice(max(0, -dy), rows - max(0, dy)), slice(max(0, -dx), columns - max(0, dx))
        there = slice(max(0, dy), rows + min(0, dy)), slice(max(0, dx), columns + min(0, dx))
        cost = cv2.transform(cv2.absdiff(one[here], other[there]), total)
        np.minimum(cost, BLOCK_COST_CLIP, out=cost)
        cost = cv2.boxFilter(cost, -1, (3, 3), borderType=cv2.BORDER_REPLICATE)
        cost += BLOCK_COST_PER_CELL * hypot(dx, dy)
        for at, direction in ((here, 0), (there, 1)):
            better = cost < least[direction][at]
            np.copyto(least[direction][at], cost, where=better)
            np.copyto(best[direction][at], number, where=better)
    cells = np.array(displacements, np.float32) * (width / columns, height / rows)
    forward, back = (
        _enlarged(sign * cells[numbers], (width, height)) for sign, numbers in zip((1, -1), best, strict=True)
    )
    return forward, back


def _enlarged(cells: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """The median over 3 x 3 cells of a flow ``[h, w, 2]``, interpolated to a width and height."""
    cv2 = opencv("capture")
    smooth = [cv2.medianBlur(np.ascontiguousarray(cells[..., axis], np.float32), 3) for axis in (0, 1)]
    return np.asarray(cv2.resize(np.stack(smooth, -1), size), np.float32)


def _displacements(reach: int, columns: int, rows: int) -> list[tuple[int, int]]:
    """Displacements (x, y) by at most ``reach`` cells that connect cells of two pictures, shortest first."""
    xs, ys = (range(-min(reach, size - 1), min(reach, size - 1) + 1) for size in (columns, rows))
    found = [(x, y) for y in ys for x in xs if x * x + y * y <= reach * reach]
    return sorted(found, key=lambda by: by[0] ** 2 + by[1] ** 2)


def opencv(extra: str) -> Any:
    """The module ``cv2``. Raises MissingExtraError, which names the extra, if it is not installed."""
    return import_extra("cv2", extra)


def picture_shift(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> tuple[float, float]:
    """Global shift of ``second`` relative to ``first``, ``[H, W, 3]`` each, in pixels, and its confidence, 0 to 1.

    Phase correlation (Kuglin and Hines, 1975) of grey pictures under a Hann window.

    Raises:
        MissingExtraError: OpenCV is not installed.
    """
    cv2 = opencv("capture")
    one, other = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32) for picture in (first, second))
    height, width = one.shape
    if min(height, width) < 2:
        return 0.0, 0.0
    (x, y), clarity = cv2.phaseCorrelate(one, other, cv2.createHanningWindow((width, height), cv2.CV_32F))
    return float(np.hypot(x, y)), float(clarity)


def consistency_mask(flow: NDArray[np.float32], back: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mask ``[H, W]`` of the pixels whose flow is forward-backward consistent, hence not occluded.

    Source: Sundaram et al., 2010.

    With ``f`` the forward and ``b`` the backward flow, ``[H, W, 2]``:
    ``|f(p) + b(p + f(p))|^2 <= 0.01 (|f(p)|^2 + |b(p + f(p))|^2) + 0.5``, and ``p + f(p)`` lies in the picture.
    """
    returned = sampled(back, flow)
    rest = _squared_lengths(flow + returned)
    lengths = _squared_lengths(flow) + _squared_lengths(returned)
    return (rest <= RELATIVE * lengths + ABSOLUTE) & inside(flow)


def same_color(
    first: NDArray[np.uint8], second: NDArray[np.uint8], flow: NDArray[np.float32], *, radius: int
) -> NDArray[np.bool_]:
    """Mask ``[H, W]`` of the pixels of ``first`` ``[H, W, 3]`` whose colour ``second`` has where flow leads.

    A plain object in front of a still background can have flow 0 both ways, which is consistent but wrong: what is
    there next has another colour. Colours are means over squares that reach ``radius`` pixels to each side, and may
    differ by :data:`COLOR_DIFFERENCE` or by :data:`UNEXPLAINED_SHARE` of the difference without flow; a change of all
    the light is subtracted. Raises MissingExtraError without OpenCV.
    """
    cv2 = opencv("capture")
    side = (2 * radius + 1, 2 * radius + 1)
    one, other = (cv2.blur(picture, side) for picture in (first, second))
    height, width = one.shape[:2]
    x = flow[..., 0] + np.arange(width, dtype=np.float32)
    y = flow[..., 1] + np.arange(height, dtype=np.float32)[:, None]
    reached = cv2.remap(other, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    samples = slice(None, None, LIGHT_STRIDE)
    light = np.median(one[samples, samples].astype(np.int16) - reached[samples, samples], axis=(0, 1))
    unlit = np.clip(one - light, 0.0, 255.0).astype(np.uint8) if light.any() else one
    mean = np.full((1, 3), 1 / 3, np.float32)
    remaining, before = (cv2.transform(cv2.absdiff(unlit, to), mean) for to in (reached, other))
    return np.asarray(remaining <= np.maximum(COLOR_DIFFERENCE, np.float32(UNEXPLAINED_SHARE) * before))


def _squared_lengths(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    # numpy sums over a short last axis take five times as long.
    return np.square(vectors[..., 0]) + np.square(vectors[..., 1])


def inside(offsets: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mask ``[H, W]`` of the pixels whose position plus offset is inside the outermost pixel centres."""
    height, width, _ = offsets.shape
    columns, rows = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
    x, y = offsets[..., 0] + columns, offsets[..., 1] + rows[:, None]
    return (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)


def sampled(values: NDArray[np.float32], offsets: NDArray[np.float32]) -> NDArray[np.float32]:
    """``values`` ``[H, W, C]`` sampled at each pixel plus its offset, same shape: bilinear, border repeated."""
    height, width, _ = offsets.shape
    x = (torch.from_numpy(offsets[..., 0]) + torch.arange(width)) * (2 / max(width - 1, 1)) - 1
    y = (torch.from_numpy(offsets[..., 1]) + torch.arange(height)[:, None]) * (2 / max(height - 1, 1)) - 1
    planes: Tensor = torch.from_numpy(np.ascontiguousarray(values)).permute(2, 0, 1)[None]
    grid = torch.stack([x, y], -1)[None]
    result = grid_sample(planes, grid, mode="bilinear", padding_mode="border", align_corners=True)
    return result[0].permute(1, 2, 0).numpy()
