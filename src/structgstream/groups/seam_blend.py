# SPDX-License-Identifier: Apache-2.0
"""Seam blend: removes the visible jump between static content of two groups.

Note [Seam blend]
~~~~~~~~~~~~~~~~
Two groups that were fitted independently show the same surface with different errors, so static content flickers once
at the border. Therefore static anchors start with their values of the frame before: the group's own values plus a
difference. Anchors of two fits next to each other show neither well, so whole neighbourhoods are blended. The
differences fade to zero in equal steps in the frames after the border. They are also halved in each frame in which the
anchor or most of its neighbours change, because motion hides the step. Differences are quantization indices
(Note [Bins]), hence exact. Most are 1 or 2, so each value is rounded by a threshold of its own; otherwise all of them
would vanish in the same frame.

A mixture of the two fits may show what neither fit shows (``border``); anchors there are not blended (``withdraw``).

Free Gaussians of two groups cannot be paired, so a group starts with its own. The exposure
(``training/online/exposure.py``), which each group fits independently, changes from that of the frame before in equal
steps, because a jump would be visible everywhere.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, fields_of, scene_of, state_of
from structgstream.training.neighbours import nearest
from structgstream.training.online.select import changed_primitives

NEIGHBOURS = 65
"""Size of a neighbourhood that is blended as a whole, the anchor included."""
MOVING_SHARE = 0.6
"""An anchor counts as dynamic if at least this share of its neighbourhood is."""
FADE_FRAMES = 5
"""Frames after the first one of a group in which differences fade."""
OWN_FRAMES = FADE_FRAMES + 3
"""In a group of so many frames or more, the last two are not blended any more."""
WITHDRAWN_NEIGHBOURS = 16
"""Size of the neighbourhood that decides whether an anchor is withdrawn, the anchor included."""
WITHDRAWN_SHARE = 0.3
"""An anchor is withdrawn if at least this share of its neighbourhood is a visible mixture."""
_GOLDEN = 0.6180339887498949


class SeamBlend:
    """Blends the frames of one group with the last frame of the group before (Note [Seam blend]).

    Args:
        before: the decoded last frame of the group before, itself blended.
        first: the group's own first frame.
        moving: mask ``[M]`` of the anchors that move at the border.
        steps: quantization steps by field; a field without one is not blended.
    """

    def __init__(self, before: Scene, first: Scene, moving: Tensor, *, steps: Mapping[str, float]) -> None:
        self._neighbours = nearest(first.anchors.positions, first.anchors.positions, NEIGHBOURS)[0]
        self._last, self._left_frames = first, FADE_FRAMES + 1
        blended = ~self._most_neighbours(moving)
        then, now = state_of(before), state_of(first)
        self._steps: dict[FieldName, float] = {
            name: steps[name] for name in fields_of("anchor") if name in steps and name in now
        }
        self._differences: dict[FieldName, Tensor] = {
            name: torch.where(blended[:, None], _bins(then[name] - now[name], step), 0)
            for name, step in self._steps.items()
        }
        self._thresholds = {name: _thresholds(difference) for name, difference in self._differences.items()}
        self._light: dict[FieldName, Tensor] = {}
        for name in fields_of("shared"):
            if name in steps and (difference := _bins(then[name] - now[name], steps[name])).any():
                self._light[name], self._steps[name] = difference, steps[name]

    @property
    def blended(self) -> int:
        """Number of anchors that have the values of the frame before."""
        return int(self._blended().sum())

    @property
    def first(self) -> Scene:
        """The group's first frame, blended."""
        return self._shown(self._last)

    def withdraw(self, mask: Tensor) -> int:
        """Excludes the anchors in the mask ``[M]``, and those between them, from the blend; returns how many were
        blended. Must be called before :meth:`scene`."""
        share = mask[self._neighbours[:, :WITHDRAWN_NEIGHBOURS]].float().mean(1)
        withdrawn = mask | (share >= WITHDRAWN_SHARE)
        count = int((withdrawn & self._blended()).sum())
        for name, difference in self._differences.items():
            self._differences[name] = torch.where(withdrawn[:, None], 0, difference)
        return count

    def scene(self, found: Scene) -> Scene:
        """The blended frame for the group's own frame ``found``; must be called for every frame, in order."""
        self._advance(found)
        shown = self._shown(found)
        self._last, self._left_frames = found, max(0, self._left_frames - 1)
        return shown

    def _blended(self) -> Tensor:
        """Mask ``[M]`` of the anchors with a difference."""
        found = torch.zeros(len(self._neighbours), dtype=torch.bool)
        for difference in self._differences.values():
            found |= difference.any(1)
        return found

    def _shown(self, found: Scene) -> Scene:
        state = state_of(found)
        for name, step in self._steps.items():
            state[name] = (_bins(state[name], step) + self._faded(name)) * step
        return scene_of(state, distance_input=found.distance_input, sampling=found.sampling)

    def _advance(self, found: Scene) -> None:
        moved = changed_primitives(self._last, found)[: len(found.anchors)]
        fading = (moved | self._most_neighbours(moved))[:, None]
        for name, difference in self._differences.items():
            self._differences[name] = torch.where(fading, torch.div(difference, 2, rounding_mode="trunc"), difference)

    def _most_neighbours(self, mask: Tensor) -> Tensor:
        """Mask ``[M]`` of the anchors most of whose neighbours are in the mask ``[M]``."""
        return mask[self._neighbours].float().mean(1) >= MOVING_SHARE

    def _faded(self, name: FieldName) -> Tensor:
        """The differences of a field that remain in this frame, in quantization steps."""
        share = self._left_frames / (FADE_FRAMES + 1)
        if name in self._light:
            return (self._light[name].double() * share).round().long()
        return (self._differences[name].double() * share + self._thresholds[name]).floor().long()


def _thresholds(values: Tensor) -> Tensor:
    """Numbers in [0, 1) of the shape of ``values``, so that ``floor(integer + threshold)`` is ``integer``.

    They are the fractional parts of multiples of the golden ratio, which spread evenly for any count.
    """
    numbers = torch.arange(values.numel(), dtype=torch.float64).reshape(values.shape)
    return (numbers * _GOLDEN).frac()


def _bins(values: Tensor, step: float) -> Tensor:
    return (values.double() / step).round().long()
