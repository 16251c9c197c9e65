# SPDX-License-Identifier: Apache-2.0
"""Seam blends of consecutive groups, whose packets are coded again."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain

from structgstream.codec.container.records import RecordType, packed, read_record
from structgstream.codec.decoder import SceneDecoder
from structgstream.codec.encoder import SceneEncoder
from structgstream.codec.packets import Packet, PacketKind, StreamHeader, parse_packet
from structgstream.groups.border import draw_border, moving_at_border, visible_mixtures
from structgstream.groups.seam_blend import SeamBlend
from structgstream.groups.segment_file import Segment
from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device

_TYPES = {PacketKind.KEY: RecordType.KEY, PacketKind.DELTA: RecordType.DELTA}
_KINDS = {record: kind for kind, record in _TYPES.items()}
WITHDRAWING_ROUNDS = 3
"""Largest number of rounds. Withdrawing an anchor changes the mixture around it, which is then tested again."""


@dataclass(frozen=True)
class Border:
    """Result of the seam blend at the beginning of a group.

    Args:
        frame: the group's first frame.
        blended: number of anchors that start with the values of the frame before.
        withdrawn: number of anchors that do not, because the mixture would be visible.
    """

    frame: int
    blended: int
    withdrawn: int


class GroupBlender:
    """Blends the groups of a stream, which must be given in order; at most four scenes are in memory.

    Args:
        header: of the stream.
        backend: the compute back-end that renders the frames around borders.
        on_border: called for each border, in order.
    """

    def __init__(
        self, header: StreamHeader, backend: Backend, *, on_border: Callable[[Border], None] | None = None
    ) -> None:
        self._header = header
        self._backend = backend
        self._rig = header.similarity.rig(header.rig)
        self._shown: deque[Scene] = deque(maxlen=2)
        self._on_border = on_border or (lambda border: None)

    def follow(self, segment: Segment) -> None:
        """Start after a group whose last two frames are not blended: the first group, or one of at least
        :data:`~structgstream.groups.seam_blend.OWN_FRAMES` frames.

        Raises:
            StreamError: a packet is damaged.
        """
        self._shown.extend(scene for _, scene in self._decoded(segment))

    def records(self, segment: Segment) -> Iterator[bytes]:
        """The records of the packets of ``segment``, blended; those of the first group are unchanged.

        Raises:
            StreamError: a packet is damaged.
        """
        if not self._shown:
            for number, (_, scene) in enumerate(self._decoded(segment)):
                self._shown.append(scene)
                yield segment.record(number)
            return
        frames = self._decoded(segment)
        begun = [next(frames)] + [frame for frame in (next(frames, None),) if frame is not None]
        seam_blend = self._begin(begun[0][0].index, [scene for _, scene in begun])
        encoder = SceneEncoder(self._header)
        for packet, scene in chain(begun, frames):
            shown = scene if seam_blend is None else seam_blend.scene(scene)
            made = encoder.encode(shown, index=packet.index, pts_seconds=packet.pts_seconds, kind=packet.kind)
            self._shown.append(made.reconstruction)
            yield packed(_TYPES[packet.kind], made.packet.payload)

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
        for number in range(len(segment.entries)):
            record = read_record(segment.record(number), 0)
            assert record is not None, "verified when the segment was opened"
            packet = parse_packet(record.payload, _KINDS[RecordType(record.type)])
            yield packet, decoder.decode(packet)
