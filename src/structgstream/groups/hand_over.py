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

A mixture of the two fits may show what neither does (``mixture``): there nothing is handed over (``withdraw``).

Free Gaussians cannot be paired, and are the group's own: what is new is there at once. The light
(``training/online/exposure.py``), which each group follows by itself, is that of the frame before and goes over in
equal steps: a jump of it would show everywhere.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, fields_of, scene_of, state_of
from structgstream.training.neighbours import nearest
from structgstream.training.online.select import changed_primitives

NEIGHBOURS = 65
"""Anchors, itself included, that are handed over together."""
MOVING_SHARE = 0.6
"""An anchor is in motion if this share of its neighbours, or more, is."""
FADE_FRAMES = 5
"""Frames after that of the border in which differences fade."""
OWN_FRAMES = FADE_FRAMES + 3
"""The last two frames of a group of so many are its own: nothing is left of what was handed over."""
WITHDRAWN_NEIGHBOURS = 16
"""Anchors, itself included, with which one is withdrawn."""
WITHDRAWN_SHARE = 0.3
"""An anchor is withdrawn if this share of its neighbours, or more, shows as a mixture."""
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
        self._neighbours = nearest(first.anchors.positions, first.anchors.positions, NEIGHBOURS)[0]
        self._last, self._left_frames = first, FADE_FRAMES + 1
        kept = ~self._most_neighbours(moving)
        then, now = state_of(before), state_of(first)
        self._steps: dict[FieldName, float] = {
            name: steps[name] for name in fields_of("anchor") if name in steps and name in now
        }
        self._differences: dict[FieldName, Tensor] = {
            name: torch.where(kept[:, None], _bins(then[name] - now[name], step), 0)
            for name, step in self._steps.items()
        }
        self._thresholds = {name: _thresholds(difference) for name, difference in self._differences.items()}
        self._light: dict[FieldName, Tensor] = {}
        for name in fields_of("shared"):
            if name in steps and (difference := _bins(then[name] - now[name], steps[name])).any():
                self._light[name], self._steps[name] = difference, steps[name]

    @property
    def handed(self) -> int:
        """Number of anchors that have values of the frame before."""
        return int(self._handed().sum())

    @property
    def first(self) -> Scene:
        """The group's first frame as it is handed over."""
        return self._shown(self._last)

    def withdraw(self, mask: Tensor) -> int:
        """Hands the anchors in the mask ``[M]``, and those between them, not over; returns how many were. It has to be
        called before :meth:`scene`."""
        share = mask[self._neighbours[:, :WITHDRAWN_NEIGHBOURS]].float().mean(1)
        withdrawn = mask | (share >= WITHDRAWN_SHARE)
        count = int((withdrawn & self._handed()).sum())
        for name, difference in self._differences.items():
            self._differences[name] = torch.where(withdrawn[:, None], 0, difference)
        return count

    def scene(self, found: Scene) -> Scene:
        """A frame of the stream instead of the group's own, ``found``; frames are given in order."""
        self._advance(found)
        shown = self._shown(found)
        self._last, self._left_frames = found, max(0, self._left_frames - 1)
        return shown

    def _handed(self) -> Tensor:
        """Mask ``[M]`` of the anchors that differ from the group's own."""
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
        """What is left in this frame of a field's differences, in bins."""
        share = self._left_frames / (FADE_FRAMES + 1)
        if name in self._light:
            return (self._light[name].double() * share).round().long()
        return (self._differences[name].double() * share + self._thresholds[name]).floor().long()


def _thresholds(values: Tensor) -> Tensor:
    """For each of the ``values`` a number from 0 to just below 1, so that ``floor(whole + threshold)`` is ``whole``.

    They are multiples of the golden section, which spread evenly however many there are.
    """
    numbers = torch.arange(values.numel(), dtype=torch.float64).reshape(values.shape)
    return (numbers * _GOLDEN).frac()


def _bins(values: Tensor, step: float) -> Tensor:
    return (values.double() / step).round().long()
