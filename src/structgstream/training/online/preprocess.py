# SPDX-License-Identifier: Apache-2.0
"""What is computed from the pictures alone: training views, changed pixels, optical flow.

Nothing here depends on the scene, so it is computed for the next frame while one is fitted (``lookahead``).

Note [Lengths of the flow search]
~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~
What moves is as large, and moves as far, as a share of the picture. So margins, cells and the reach of the search for
large motion are shares of the longer side. The floor of the margin is in pixels because the search compares patches of
8 pixels.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import floor, log2
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.flow import ABSOLUTE, RELATIVE, block_search, dis_refinement, dis_search, same_color
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend, on_processor
from structgstream.training.online.config import MotionConfig, SceneFlowConfig
from structgstream.training.views import (
    View,
    area_mean,
    blackened,
    evidence_views,
    in_groups,
    mean_of_counting,
    stacked_colors,
    stacked_masks,
    training_views,
)

CONTEXT_SHARE, MIN_CONTEXT_PIXELS = 1 / 40, 16
"""Margin around the bounding box of the changed pixels, in which flow is estimated: share of the picture's longer side,
but at least so many pixels (Note [Lengths of the flow search])."""
MIN_SAVING = 0.8
"""Boxes around parts have to be together smaller than this share of the box around all."""
MIN_SEARCH_PIXELS = 240
"""Flow is searched up to half of the pictures' size, or, if the longer side of that has fewer pixels, up to their full
size: in small pictures what moves is small, too."""
CELLS, REACH_CELLS = 80, 12
"""Number of cells along the picture's longer side in the search for large motion, and the largest displacement, in
cells, that the search finds: 15 per cent of the longer side."""
COLOR_SHARE = 1 / 640
"""Radius of the squares whose mean colours flow is checked by (``flow.same_color``), relative to the longer side."""
MISSED_CELLS, CONSISTENT_SHARE = 3, 0.5
"""Large motion is searched for around squares of this many cells on a side if, in each of their cells, less than this
share of the changed pixels has consistent flow. That finds objects that have moved out of their own outline, and leaves
out the narrow bands that slower motion occludes. The search compares squares of three cells."""
REPEATED_LEVELS = 0.2
"""Mean absolute difference, in levels of 255, below which a picture without a changed pixel is the last one once more.

A frozen picture that is encoded again differs by up to 0.16 (H.264, rate factors 6 and 23, from the second repetition
on); the noise of a camera alone by more: at least 1.2 in every camera of basketball, 2.5 in counter."""


@dataclass(frozen=True)
class PictureChange:
    """Change of a training picture since the previous one.

    Args:
        changed: ``[H, W]`` bool, dilated mask of the changed pixels.
        repeated: whether it is the previous picture once more, equal or encoded again: a frozen camera's.
        flow: ``[h, w, 6]`` the maps of :func:`flow_map` from the previous picture to this one, and the previous
            picture in 0 ... 1; None if flow was not estimated.
        flow_counts: what the search for flow did, for the log (:class:`FlowMaps`).
    """

    changed: Tensor
    repeated: bool
    flow: Tensor | None = None
    flow_counts: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class FramePictures:
    """The training views of a frame.

    Args:
        views: in rig order, without absent cameras.
        changes: of each of them since the previous frame, None for a camera that was absent from that; None without
            motion selection.
    """

    views: list[View]
    changes: list[PictureChange | None] | None

    @property
    def flow_counts(self) -> dict[str, int]:
        """What the search for flow did in all views, for the log."""
        counts = Counter[str]()
        for change in self.changes or []:
            counts.update(change.flow_counts if change is not None else {})
        return dict(counts)


def preprocess(
    frame: MultiViewFrame,
    rig: CameraRig,
    *,
    before: Sequence[View] | None,
    motion: MotionConfig,
    scene_flow: SceneFlowConfig,
    backend: Backend,
) -> FramePictures:
    """The pictures of ``frame``, and their changes since the views ``before`` (None: without motion selection).

    With fewer cameras in both frames than a primitive needs votes there is no motion selection: everything is trained.

    Raises:
        MissingExtraError: flow is needed and OpenCV is not installed.
    """
    views = training_views(frame, rig, backend.device)
    if before is None or not motion.enabled:
        return FramePictures(views, None)
    known = {view.index for view in before}
    compared = [view for view in views if view.index in known]
    if len(compared) < min(motion.MIN_VOTES, len(rig.training)):
        return FramePictures(views, None)
    flow_from = flow_views(compared, frame.index, scene_flow)
    changes = detect_changes(views, before, config=motion, backend=backend, flow_from=flow_from)
    return FramePictures(views, changes)


def flow_views(views: Sequence[View], frame_index: int, config: SceneFlowConfig) -> frozenset[int]:
    """Indices of the views in which flow is estimated in a frame; none if the scene flow is disabled."""
    if not config.enabled:
        return frozenset()
    stride = -(-len(views) // max(config.views, 2))
    return frozenset(view.index for n, view in enumerate(views) if n % stride == frame_index % stride)


def detect_changes(
    views: Sequence[View],
    before: Sequence[View],
    *,
    config: MotionConfig,
    backend: Backend,
    flow_from: Collection[int] = (),
) -> list[PictureChange | None]:
    """Change of each of ``views`` since the picture of the same camera in ``before``; None if that has none.

    A camera that was absent is not compared with an older picture: what changed since then is in the scene already.
    Pixels that either picture leaves out have not changed, and their flow has no confidence.

    Args:
        views: of a frame.
        before: of the previous frame.
        config: threshold of change, dilation, and size of the maps of flow (``View.evidence``).
        backend: the compute back-end.
        flow_from: indices of the views in which flow is estimated.
    """
    earlier = {last.index: last for last in before}

    def changes(alike: list[View]) -> Sequence[PictureChange | None]:
        if alike[0].index not in earlier:
            return [None] * len(alike)
        last = [earlier[view.index] for view in alike]
        return _detect_changes(alike, last, config=config, backend=backend, flow_from=flow_from)

    with torch.no_grad():
        return in_groups(
            views,
            lambda view: (view.image.shape, view.camera.near, view.index in earlier),
            changes,
            device=backend.device,
        )


def _detect_changes(
    views: Sequence[View],
    before: Sequence[View],
    *,
    config: MotionConfig,
    backend: Backend,
    flow_from: Collection[int],
) -> list[PictureChange]:
    """Of views of one size, with their earlier pictures."""
    masks, other_masks = stacked_masks(views), stacked_masks(before)
    both = other_masks if masks is None else masks if other_masks is None else masks & other_masks
    then, now = (blackened(torch.stack([view.image for view in some]), both) for some in (before, views))
    reach = round(config.REACH_PIXELS * views[0].enlargement)
    changed = backend.changed_pixels(then, now, threshold=config.CHANGE_THRESHOLD, reach_pixels=reach)
    changed = changed if both is None else changed & both
    rows = [row for row, view in enumerate(views) if view.index in flow_from]
    everywhere = torch.ones_like(changed) if both is None else both
    any_changed, *here = on_processor(  # Where flow is searched.
        changed.flatten(1).any(1), *(given[rows] for given in (then, now, changed, everywhere))
    )
    repeated = _are_repeated(then, now, both, same=(~any_changed).nonzero()[:, 0].tolist())
    found = [PictureChange(*of_view) for of_view in zip(changed, repeated, strict=True)]
    if not rows:
        return found
    small, last = (evidence_views([some[row] for row in rows], config.picture_scale) for some in (views, before))
    size = (small[0].camera.height, small[0].camera.width)
    estimated = [
        flow_map(first, second, where, size, mask=mask, backend=backend)
        for first, second, where, mask in zip(*here, strict=True)
    ]
    maps = torch.stack([of_view.maps for of_view in estimated]).to(changed.device)
    maps = torch.cat([maps, stacked_colors(last)], dim=-1)
    for row, of_view, flow_maps in zip(rows, estimated, maps, strict=True):
        found[row] = replace(found[row], flow=flow_maps, flow_counts=of_view.counts)
    return found


def _are_repeated(then: Tensor, now: Tensor, masks: Tensor | None, *, same: list[int]) -> list[bool]:
    """For each view, whether its picture in ``now`` repeats that in ``then``. Only views in ``same``, where no pixel
    has changed, can; ``masks`` are the pixels that count in both pictures."""
    if not same:
        return [False] * len(now)

    def means_of(rows: list[int]) -> list[float]:
        levels = (now[rows].int() - then[rows].int()).abs().float().mean(-1)
        return mean_of_counting(levels, None if masks is None else masks[rows]).tolist()

    # Whole numbers of whole pictures: on the processor of one at a time.
    means = means_of(same) if now.device.type != "cpu" else [mean for row in same for mean in means_of([row])]
    repeated = {row for row, mean in zip(same, means, strict=True) if mean < REPEATED_LEVELS}
    return [row in repeated for row in range(len(now))]


class FlowMaps(NamedTuple):
    """Flow between two pictures of one camera with confidence c, the share of consistent pixels.

    Args:
        maps: ``[h, w, 3]``: c, c flow_x and c flow_y (``Backend.confident_flow``).
        counts: for the log: the boxes in which large motion was searched for (``far boxes``), the changed pixels for
            which that search found a consistent flow (``far pixels``), and those whose flow leads to another colour,
            in either search (``recolored pixels``).
    """

    maps: Tensor
    counts: Mapping[str, int]


def flow_map(
    first: Tensor,
    second: Tensor,
    changed: Tensor,
    size: tuple[int, int],
    *,
    mask: Tensor | None = None,
    backend: Backend,
) -> FlowMaps:
    """Flow between two pictures of one camera.

    It is estimated in one box for each part of ``changed``, or in one box around all parts. Where the result is
    inconsistent, a second search looks for objects that move farther than their own size (:func:`block_search`).
    Outside the boxes the confidence is zero.

    Args:
        first: ``[H, W, 3]`` uint8, on the processor.
        second: ``[H, W, 3]`` uint8, on the processor.
        changed: ``[H, W]`` bool, where the two differ, on the processor.
        size: h and w of the maps; flow is in pixels of the pictures.
        mask: ``[H, W]`` bool, pixels that may have confidence, on the processor; None for all.
        backend: the compute back-end.

    Raises:
        MissingExtraError: OpenCV is not installed.
    """
    maps = torch.zeros(3, *changed.shape)
    counts = {"far boxes": 0, "far pixels": 0, "recolored pixels": 0}
    where = changed.numpy()
    longer = max(where.shape)
    level = 1 if longer // 2 >= MIN_SEARCH_PIXELS else 0
    context = max(MIN_CONTEXT_PIXELS, round(CONTEXT_SHARE * longer))
    radius = max(1, round(COLOR_SHARE * longer))
    search = dis_search("capture", refined=False, finest_level=level)

    def consistent(
        box: Box,
        earlier: NDArray[np.uint8],
        later: NDArray[np.uint8],
        flow: NDArray[np.float32],
        back: NDArray[np.float32],
    ) -> Tensor:
        alike = torch.from_numpy(same_color(earlier, later, flow, radius=radius))
        counts["recolored pixels"] += int(where[box][~alike.numpy()].sum())
        counting = alike if mask is None else alike & mask[box]
        forward, backward = torch.from_numpy(flow), torch.from_numpy(back)
        return backend.confident_flow(forward, backward, counting, relative=RELATIVE, absolute=ABSOLUTE)

    cell = max(1, round(longer / CELLS))
    for box in _boxes(where, context):
        earlier, later = _cut(first, box), _cut(second, box)
        maps[:, *box] = consistent(box, earlier, later, search(earlier, later), search(later, earlier))
    for box in _far_boxes(where, maps[0].numpy() > 0.0, cell):
        earlier, later = _cut(first, box), _cut(second, box)
        flows = block_search(earlier, later, cell_pixels=cell, reach_cells=REACH_CELLS)
        refine = dis_refinement(finest_level=level, coarsest_level=max(level, floor(log2(cell)) - 1))
        found = consistent(box, earlier, later, refine(earlier, later, flows[0]), refine(later, earlier, flows[1]))
        missing = torch.from_numpy(where[box]) & (maps[0][box] == 0.0)
        counts["far boxes"] += 1
        counts["far pixels"] += int((missing & (found[0] > 0.0)).sum())
        maps[:, *box] = torch.where(missing, found, maps[:, *box])
    return FlowMaps(area_mean(maps[None], size)[0].permute(1, 2, 0), counts)


Box = tuple[slice, slice]
Mask = NDArray[np.bool_]
Edges = tuple[int, int, int, int]
"""First and end row, first and end column of a box."""


def _cut(picture: Tensor, box: Box) -> NDArray[np.uint8]:
    return np.ascontiguousarray(picture[box].numpy())


def _boxes(mask: Mask, context: int) -> list[Box]:
    """Disjoint boxes around the parts of the mask ``[H, W]``, with a margin of ``context`` pixels; one around all if
    that is hardly larger. Boxes that are too small for the flow search are left out."""
    if not mask.any():
        return []
    rows, columns = (np.flatnonzero(mask.any(axis)).tolist() for axis in (1, 0))
    edges = (rows[0] - context, rows[-1] + 1 + context, columns[0] - context, columns[-1] + 1 + context)
    one = _within(edges, mask.shape)
    if not _searchable(one, context):
        return []
    # First down the columns, whose steps are long: NumPy takes ten times as long for both at once.
    cells = np.logical_or.reduce(_in_cells(mask, context).any(1), axis=2)
    found = [_within((context * a, context * b, context * c, context * d), mask.shape) for a, b, c, d in _parts(cells)]
    if sum(map(_area, found)) > MIN_SAVING * _area(one):
        return [one]
    return [box for box in found if _searchable(box, context)]


def _searchable(box: Box, context: int) -> bool:
    """Whether ``box`` is not too small for the flow search."""
    return min(span.stop - span.start for span in box) >= 2 * context


def _in_cells(mask: Mask, side: int) -> Mask:
    """The mask ``[H, W]``, padded to whole cells, as ``[rows, side, columns, side]``."""
    rows, columns = (-(-length // side) for length in mask.shape)
    padded = np.zeros((rows * side, columns * side), bool)
    padded[: mask.shape[0], : mask.shape[1]] = mask
    return padded.reshape(rows, side, columns, side)


def _far_boxes(changed: Mask, consistent: Mask, cell: int) -> list[Box]:
    """Boxes in which large motion is searched for: parts that changed without consistent flow, with margin.

    Args:
        changed: ``[H, W]``.
        consistent: ``[H, W]``, pixels with consistent flow.
        cell: pixels of a cell's side.
    """
    import cv2  # The flow search has refused to go on without it.

    count, found = (_in_cells(mask, cell).sum((1, 3)) for mask in (changed, changed & consistent))
    missed = (count >= cell**2 / 2) & (found < CONSISTENT_SHARE * count)
    missed = cv2.morphologyEx(missed.astype(np.uint8), cv2.MORPH_OPEN, np.ones((MISSED_CELLS, MISSED_CELLS), np.uint8))
    reach = REACH_CELLS * cell
    edges = [
        (cell * top - reach, cell * bottom + reach, cell * left - reach, cell * right + reach)
        for top, bottom, left, right in _parts(missed > 0)
    ]
    return [_within(box, changed.shape) for box in _disjoint(edges)]


def _parts(cells: Mask) -> list[Edges]:
    """Disjoint boxes (first and end row, first and end column) around the connected parts of ``cells`` and the eight
    cells around each."""
    import cv2  # The flow search has refused to go on without it.

    grown = cv2.dilate(cells.astype(np.uint8), np.ones((3, 3), np.uint8))
    _, _, stats, _ = cv2.connectedComponentsWithStats(grown, connectivity=8)
    boxes = np.asarray(stats)[1:, :4].tolist()  # The first is what is no part.
    return _disjoint([(top, top + height, first, first + width) for first, top, width, height in boxes])


def _disjoint(boxes: Sequence[Edges]) -> list[Edges]:
    """``boxes``, those that overlap replaced by one around both until none do."""
    left, done = list(boxes), list[Edges]()
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


def _overlap(one: Edges, other: Edges) -> bool:
    return one[0] < other[1] and other[0] < one[1] and one[2] < other[3] and other[2] < one[3]


def _within(edges: Edges, shape: tuple[int, ...]) -> Box:
    """The part of a box that lies in a picture of this shape."""
    top, bottom, left, right = edges
    return slice(max(top, 0), min(bottom, shape[0])), slice(max(left, 0), min(right, shape[1]))


def _area(box: Box) -> int:
    rows, columns = box
    return (rows.stop - rows.start) * (columns.stop - columns.start)
