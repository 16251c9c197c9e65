# SPDX-License-Identifier: Apache-2.0
"""The frames of a group without a jump from the group before: what stands still is handed over as it moves.

Note [Hand-over]
~~~~~~~~~~~~~~~~
Two groups that were fitted apart show the same surface with different errors, so that what stands still flickers once
at the border. Therefore anchors that stand still there keep their values of the frame before: the group's own values
plus a difference. Two fits side by side show neither well, so whole neighbourhoods are handed over, and differences
fade: to zero in the frames after the border, in equal steps, so that no step is seen, and besides by half in each frame
in which the anchor or most of its neighbours change, where motion hides that. They are bins (Note [Bins]), hence exact;
most are of one or two, so each value is rounded by a threshold of its own, else all of these would go in one frame.

Free Gaussians cannot be paired. Where things stand still those of the frame before stay, and those of the group's first
frame are withheld; they change places when most of the anchors around change, or when differences have faded. A birth
that was withheld gets an identity of the frame in which it appears, since births of a stream ascend.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from structgstream.errors import MissingExtraError
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, fields_of, scene_of, state_of
from structgstream.training.motion import changed_movers
from structgstream.training.patching import BIRTHS_PER_FRAME

NEIGHBOURS = 65
"""Anchors, itself included, that are handed over together."""
MOVING_SHARE = 0.6
"""An anchor is in motion if this share of its neighbours, or more, is."""
FADE_FRAMES = 5
"""Frames after that of the border in which differences fade."""
_GOLDEN = 0.6180339887498949


class HandOver:
    """The frames of one group, after another one's.

    Args:
        before: the decoded frame before the group, as it is shown.
        first: the group's own first frame.
        moving: mask ``[M]`` of the anchors that move at the border.
        steps: quantization steps by field; a field without one is the group's own.
    """

    def __init__(self, before: Scene, first: Scene, moving: Tensor, *, steps: Mapping[str, float]) -> None:
        self._nearest = _Nearest(first.anchors.positions)
        kept = self._nearest.share(moving) < MOVING_SHARE
        self._kept, self._last, self._left_frames = kept, first, FADE_FRAMES + 1
        then, now = state_of(before), state_of(first)
        self._steps: dict[FieldName, float] = {
            name: steps[name] for name in fields_of("anchor") if name in steps and name in now
        }
        self._differences: dict[FieldName, Tensor] = {
            name: torch.where(kept[:, None], _bins(then[name] - now[name], step), 0)
            for name, step in self._steps.items()
        }
        self._thresholds = {name: _thresholds(difference) for name, difference in self._differences.items()}
        self._left = _Placed(before.free, self._nearest.anchor(before.free.means)).of(kept)
        self._withheld = _Placed(first.free, self._nearest.anchor(first.free.means)).of(kept)
        self._renamed = {int(birth): -1 for birth in self._withheld.free.births}

    def scene(self, found: Scene, *, index: int) -> Scene:
        """The frame ``index`` of the stream instead of the group's own, ``found``; frames are given in order."""
        self._advance(found)
        state = state_of(found)
        for name, step in self._steps.items():
            state[name] = (_bins(state[name], step) + self._faded(name)) * step
        shown = scene_of(state, distance_input=found.distance_input)
        self._last, self._left_frames = found, max(0, self._left_frames - 1)
        return replace(shown, free=self._free(found.free, index))

    def _advance(self, found: Scene) -> None:
        moved = changed_movers(self._last, found)[: len(self._kept)]
        moving = self._nearest.share(moved) >= MOVING_SHARE
        self._kept = self._kept & ~moving & (self._left_frames > 0)
        fading = (moved | moving)[:, None]
        for name, difference in self._differences.items():
            self._differences[name] = torch.where(fading, torch.div(difference, 2, rounding_mode="trunc"), difference)

    def _faded(self, name: FieldName) -> Tensor:
        """What is left in this frame of a field's differences, in bins."""
        share = self._left_frames / (FADE_FRAMES + 1)
        return (self._differences[name].double() * share + self._thresholds[name]).floor().long()

    def _free(self, own: FreeGaussians, index: int) -> FreeGaussians:
        """Free Gaussians of the frame: those of before that are left, and the group's ``own`` that are not withheld."""
        self._left, self._withheld = self._left.of(self._kept), self._withheld.of(self._kept)
        births = own.births.clone()
        numbers = births[births // BIRTHS_PER_FRAME == index] % BIRTHS_PER_FRAME
        free_number = int(numbers.max()) + 1 if len(numbers) else 0
        hidden = set(self._withheld.free.births.tolist())
        shown = torch.ones(len(own), dtype=torch.bool)
        for row, birth in enumerate(births.tolist()):
            if birth in hidden:
                shown[row] = False
            elif birth in self._renamed:
                if self._renamed[birth] < 0:
                    self._renamed[birth] = index * BIRTHS_PER_FRAME + free_number
                    free_number += 1
                births[row] = self._renamed[birth]
        renamed = replace(own, births=births).select(shown)
        both = self._left.free.append(renamed)
        return both.select(both.births.argsort())


class _Nearest:
    """The neighbourhoods of anchors at ``positions`` ``[M, 3]``."""

    def __init__(self, positions: Tensor) -> None:
        try:
            from scipy.spatial import KDTree
        except ImportError as error:
            raise MissingExtraError("scipy", "capture") from error
        points = positions.double().numpy(force=True)
        self._tree = KDTree(points)
        ranks: Any = [*range(1, min(NEIGHBOURS, len(points)) + 1)]  # A list, so that the result has two dimensions.
        _, rows = self._tree.query(points, k=ranks)
        self._rows = torch.from_numpy(rows).long()

    def share(self, mask: Tensor) -> Tensor:
        """Share of the neighbours of each anchor that are in the mask ``[M]``."""
        return mask[self._rows].float().mean(1)

    def anchor(self, points: Tensor) -> Tensor:
        """The nearest anchor to each of the points ``[F, 3]``."""
        return torch.from_numpy(self._tree.query(points.double().numpy(force=True))[1]).long()


@dataclass(frozen=True)
class _Placed:
    """Free Gaussians, each with the row of the anchor that decides about it."""

    free: FreeGaussians
    anchors: Tensor

    def of(self, mask: Tensor) -> "_Placed":
        """Those whose anchor is in the mask ``[M]``."""
        rows = mask[self.anchors]
        return _Placed(self.free.select(rows), self.anchors[rows])


def _thresholds(values: Tensor) -> Tensor:
    """For each of the ``values`` a number from 0 to just below 1, so that ``floor(whole + threshold)`` is ``whole``.

    They are multiples of the golden section, which spread evenly however many there are.
    """
    numbers = torch.arange(values.numel(), dtype=torch.float64).reshape(values.shape)
    return (numbers * _GOLDEN).frac()


def _bins(values: Tensor, step: float) -> Tensor:
    return (values.double() / step).round().long()
