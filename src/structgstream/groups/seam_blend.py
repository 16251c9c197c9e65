# SPDX-License-Identifier: Apache-2.0
"""Seam blend: removes the visible jump between static content of two groups.

Note [Seam blend]
~~~~~~~~~~~~~~~~
Two groups that were fitted independently show the same surface with different errors, so static content flickers once
at the border. Therefore static anchors start with their values of the frame before: the group's own values plus a
difference. Anchors of two fits next to each other show neither well, so whole neighbourhoods are blended. The
differences fade to zero in equal steps in the frames after the border. They are also halved in each frame in which the
anchor or most of its neighbours change, because motion hides the step. Differences are quantization indices (Note
[Bins]), hence exact. Most are 1 or 2, so each value is rounded by a threshold of its own; otherwise all of them would
vanish in the same frame.

On an untextured moving body, or where one fit has a free Gaussian and the other has anchors, a mixture of the two fits
may show what neither shows, although no change is detected there; renderings of both fits find anchors that move, and
such mixtures, which are not blended (``withdraw``). Free Gaussians of two groups cannot be paired, so a group starts
with its own. The exposure (``training/online/exposure.py``), which each group fits independently, changes from that of
the frame before in equal steps, because a jump would be visible everywhere.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain, islice

import torch
from torch import Tensor

from structgstream.cameras import CameraRig, enlargement
from structgstream.codec.container.records import RECORD_TYPES, packed
from structgstream.codec.packets import Packet, StreamHeader
from structgstream.codec.scene_coder import SceneDecoder, SceneEncoder
from structgstream.groups.segment_file import Segment, packet_of
from structgstream.kernels.backend import Backend
from structgstream.scene.render import render, to_8bit_image
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, fields_of, on_device, scene_of, state_of
from structgstream.training.neighbours import nearest
from structgstream.training.online.config import MotionConfig
from structgstream.training.online.measure import measure, primitive_sums, slot_count
from structgstream.training.online.preprocess import detect_changes
from structgstream.training.online.select import changed_primitives, select_dynamic
from structgstream.training.views import View, area_mean

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
        first: the decoded first frame of the group.
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
        self._exposure: dict[FieldName, Tensor] = {}
        for name in fields_of("shared"):
            if name in steps and (difference := _bins(then[name] - now[name], steps[name])).any():
                self._exposure[name], self._steps[name] = difference, steps[name]

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
        if name in self._exposure:
            return (self._exposure[name].double() * share).round().long()
        return (self._differences[name].double() * share + self._thresholds[name]).floor().long()


def _thresholds(values: Tensor) -> Tensor:
    """Numbers in [0, 1) of the shape of ``values``, so that ``floor(integer + threshold)`` is ``integer``.

    They are the fractional parts of multiples of the golden ratio, which spread evenly for any count.
    """
    numbers = torch.arange(values.numel(), dtype=torch.float64).reshape(values.shape)
    return (numbers * _GOLDEN).frac()


def _bins(values: Tensor, step: float) -> Tensor:
    return (values.double() / step).round().long()


CAMERAS = 9
"""Least number of training cameras, at equal distances in the rig, for which the frames around a border are drawn, or
all of a smaller rig. Fewer than twice as many are drawn."""


@dataclass(frozen=True)
class BorderPictures:
    """Renderings of the two frames at a border; of nine cameras at 640 x 360 they take 50 MB."""

    before: Mapping[str, Tensor]  # rendering [H, W, 3] of the last frame of the group before, by camera
    first: Mapping[str, Tensor]  # rendering [H, W, 3] of the first frame of the group, by camera


def draw_border(before: Scene, first: Scene, rig: CameraRig, backend: Backend) -> BorderPictures:
    """Draws the last frame of a group and the first one of the next."""
    names = rig.training[:: max(1, len(rig.training) // CAMERAS)]
    with torch.no_grad():
        then, now = ({name: render(scene, rig[name], backend).image for name in names} for scene in (before, first))
    return BorderPictures(then, now)


def moving_at_border(
    before: Scene,
    first: Scene,
    pictures: BorderPictures,
    rig: CameraRig,
    backend: Backend,
    *,
    earlier: Scene | None = None,
    second: Scene | None = None,
) -> Tensor | None:
    """Mask ``[M]`` of the anchors of ``first`` that move; None if everything changes, as at a cut. The rig is in the
    units of the scene.

    An anchor moves if the selection of an online frame finds it between the renderings of ``before`` and ``first``, or
    if it changed from ``earlier`` to ``before`` or from ``first`` to ``second``, which groups of one frame lack. The
    second test is needed because slow motion, and fast motion of an untextured surface, change the pictures by less
    than the two fits differ.
    """
    config = MotionConfig(enabled=True, picture_scale=0.5)
    views, earlier_views = (_as_views(drawn, rig, backend) for drawn in (pictures.first, pictures.before))
    changes = detect_changes(views, earlier_views, config=config, backend=backend)
    measured = measure(first, views, changes, config=config, backend=backend)
    found = select_dynamic(first, measured, config=config, backend=backend)
    if found.scene_cut:
        return None
    moving = found.anchors
    for older, newer in ((earlier, before), (first, second)):
        if older is not None and newer is not None:
            moving = moving | changed_primitives(older, newer)[: len(moving)]
    return moving


def _as_views(drawn: Mapping[str, Tensor], rig: CameraRig, backend: Backend) -> list[View]:
    """Renderings as if they were pictures of their cameras."""
    pictures = ((name, torch.from_numpy(to_8bit_image(image)).to(backend.device)) for name, image in drawn.items())
    return [View(row, rig[name], picture) for row, (name, picture) in enumerate(pictures)]


TOLERANCE = 3.0 / 255.0
"""A pixel may be so far outside the range of the two fits. A smaller tolerance adds flicker without a gain
(lab/notes/groups-measured.md)."""
MIN_EXCESS = 1.0 / 255.0
"""An anchor is a visible mixture if the mean distance beyond the tolerance, over the pixels it covers, reaches this."""
MIN_COVERED_PIXELS = 0.5
"""Anchors that cover fewer pixels of the reduced pictures do not count."""
_SCALE = 0.5  # relative to pictures of the reference size


def visible_mixtures(mixed: Scene, pictures: BorderPictures, rig: CameraRig, backend: Backend) -> Tensor:
    """Mask ``[M]`` of the anchors of ``mixed`` that cover pixels that differ from both ``pictures`` of the border; the
    rig is in the units of the scene.

    A pixel may have any colour between those of the two.
    """
    folded, count = mixed.with_folded_appearance(), len(mixed.anchors)
    sums = torch.zeros(count, 2).to(mixed.anchors.positions)
    with torch.no_grad():
        for name in pictures.first:
            camera = rig[name]
            small = camera.scaled(_SCALE / enlargement(camera.width, camera.height))
            shown = render(mixed, camera, backend).image
            excess = _excess(shown, pictures.before[name], pictures.first[name])
            excess = area_mean(excess[None, None], (small.height, small.width))
            gaussians, slots = folded.gaussians(small, backend), slot_count(folded)
            maps = torch.stack([torch.ones_like(excess[0]), excess[0]], dim=-1)
            weighed = backend.weigh_views([gaussians], [small.viewport(maps)], maps, slots=slots)
            sums += primitive_sums(weighed[0], folded)[:count]
    covered = sums[:, 0]
    return (covered > MIN_COVERED_PIXELS) & (sums[:, 1] > MIN_EXCESS * covered)


def _excess(mixed: Tensor, before: Tensor, first: Tensor) -> Tensor:
    """Distance ``[H, W]`` of each pixel of ``mixed`` ``[H, W, 3]`` beyond the tolerance, mean over channels."""
    then, own, shown = (image.clamp(0.0, 1.0) for image in (before, first, mixed))
    allowed = shown.clamp(torch.minimum(then, own), torch.maximum(then, own))
    return ((shown - allowed).abs().mean(-1) - TOLERANCE).clamp(min=0.0)


WITHDRAWING_ROUNDS = 3
"""Largest number of rounds. Withdrawing an anchor changes the mixture around it, which is then tested again."""


@dataclass(frozen=True)
class Border:
    """Result of the seam blend at the beginning of a group."""

    frame: int  # the group's first frame
    blended: int  # number of anchors that start with the values of the frame before
    withdrawn: int  # number of anchors that do not, because the mixture would be visible


class GroupBlender:
    """Blends the groups of a stream, which must be given in order; at most four scenes are in memory. The frames around
    borders are rendered by ``backend``."""

    def __init__(self, header: StreamHeader, backend: Backend, *, on_border: Callable[[Border], object]) -> None:
        self._header, self._backend = header, backend
        self._rig = header.similarity.rig(header.rig)
        self._shown: deque[Scene] = deque(maxlen=2)
        self._on_border = on_border

    def follow(self, segment: Segment) -> None:
        """Start after a group whose last two frames are not blended: the first group, or one of at least
        :data:`~structgstream.groups.seam_blend.OWN_FRAMES` frames. Raises StreamError if a packet is damaged."""
        self._shown.extend(scene for _, scene in self._decoded(segment))

    def records(self, segment: Segment) -> Iterator[bytes]:
        """The records of the packets of ``segment``, blended; those of the first group are unchanged. Raises
        StreamError if a packet is damaged."""
        if not self._shown:
            for data, (_, scene) in zip(segment.records(), self._decoded(segment)):
                self._shown.append(scene)
                yield data
            return
        frames = self._decoded(segment)
        begun = [*islice(frames, 2)]
        seam_blend = self._begin(begun[0][0].index, [scene for _, scene in begun])
        encoder = SceneEncoder(self._header)
        for packet, scene in chain(begun, frames):
            shown = scene if seam_blend is None else seam_blend.scene(scene)
            made = encoder.encode(shown, index=packet.index, pts_seconds=packet.pts_seconds, kind=packet.kind)
            self._shown.append(made.reconstruction)
            yield packed(RECORD_TYPES[packet.kind], made.packet.payload)

    def _begin(self, frame: int, begun: list[Scene]) -> SeamBlend | None:
        """The seam blend of a group, from its first one or two frames; None if everything changes."""
        device = self._backend.device
        *earlier, before = (on_device(scene, device) for scene in self._shown)
        first, *second = (on_device(scene, device) for scene in begun)
        pictures = draw_border(before, first, self._rig, self._backend)
        moving = moving_at_border(
            before,
            first,
            pictures,
            self._rig,
            self._backend,
            earlier=earlier[0] if earlier else None,
            second=second[0] if second else None,
        )
        if moving is None:
            self._on_border(Border(frame, 0, 0))
            return None
        seam_blend, withdrawn = SeamBlend(self._shown[-1], begun[0], moving.cpu(), steps=self._header.steps), 0
        for _ in range(WITHDRAWING_ROUNDS):
            mixed = on_device(seam_blend.first, device)
            more = seam_blend.withdraw(visible_mixtures(mixed, pictures, self._rig, self._backend).cpu())
            if not more:
                break
            withdrawn += more
        self._on_border(Border(frame, seam_blend.blended, withdrawn))
        return seam_blend

    def _decoded(self, segment: Segment) -> Iterator[tuple[Packet, Scene]]:
        decoder = SceneDecoder(self._header)
        for packet in map(packet_of, segment.records()):
            yield packet, decoder.decode(packet)
