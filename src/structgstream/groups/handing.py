# SPDX-License-Identifier: Apache-2.0
"""The packets of groups one after the other, each coded again after what stands still was handed over to it."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain

from structgstream.codec.container.records import RecordType, packed, read_record
from structgstream.codec.decoder import SceneDecoder
from structgstream.codec.encoder import SceneEncoder
from structgstream.codec.packets import Packet, PacketKind, StreamHeader, parse_packet
from structgstream.groups.border import draw_border, moving_at_border
from structgstream.groups.hand_over import HandOver
from structgstream.groups.mixture import visible_mixtures
from structgstream.groups.segment_file import Segment
from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device

_TYPES = {PacketKind.KEY: RecordType.KEY, PacketKind.DELTA: RecordType.DELTA}
_KINDS = {record: kind for kind, record in _TYPES.items()}
WITHDRAWING_ROUNDS = 3
"""At most. What is withdrawn changes the mixture around it, which is looked at again."""


@dataclass(frozen=True)
class Border:
    """What happened where a group begins.

    Args:
        frame: the group's first frame.
        handed: number of anchors with values of the frame before.
        withdrawn: number of those that would have had them, had the mixture not shown.
    """

    frame: int
    handed: int
    withdrawn: int


class Handing:
    """The records of a stream's groups, which are given in order; four scenes are in memory at most.

    Args:
        header: of the stream.
        backend: the compute back-end, which draws the frames around borders.
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
        """Begin after a group whose last two frames are shown as they are: the first one, or one of
        :data:`~structgstream.groups.hand_over.OWN_FRAMES` or more.

        Raises:
            StreamError: a packet is damaged.
        """
        self._shown.extend(scene for _, scene in self._decoded(segment))

    def records(self, segment: Segment) -> Iterator[bytes]:
        """The records of the packets of ``segment``; those of the first group are its own.

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
        hand_over = self._begin(begun[0][0].index, [scene for _, scene in begun])
        encoder = SceneEncoder(self._header)
        for packet, scene in chain(begun, frames):
            shown = scene if hand_over is None else hand_over.scene(scene)
            made = encoder.encode(shown, index=packet.index, pts_seconds=packet.pts_seconds, kind=packet.kind)
            self._shown.append(made.reconstruction)
            yield packed(_TYPES[packet.kind], made.packet.payload)

    def _begin(self, frame: int, begun: list[Scene]) -> HandOver | None:
        """The hand-over to a group from its first one or two frames; None where everything changes."""
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
        hand_over, withdrawn = HandOver(self._shown[-1], begun[0], moving.cpu(), steps=self._header.steps), 0
        for _ in range(WITHDRAWING_ROUNDS):
            mixed = on_device(hand_over.first, device)
            more = hand_over.withdraw(visible_mixtures(mixed, pictures, self._rig, self._backend).cpu())
            if not more:
                break
            withdrawn += more
        self._on_border(Border(frame, hand_over.handed, withdrawn))
        return hand_over

    def _decoded(self, segment: Segment) -> Iterator[tuple[Packet, Scene]]:
        decoder = SceneDecoder(self._header)
        for number in range(len(segment.entries)):
            record = read_record(segment.record(number), 0)
            assert record is not None, "verified when the segment was opened"
            packet = parse_packet(record.payload, _KINDS[RecordType(record.type)])
            yield packet, decoder.decode(packet)
