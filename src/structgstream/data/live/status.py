# SPDX-License-Identifier: Apache-2.0
"""What live cameras and queues do at a moment, as plain values."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from structgstream.data.live.arrivals import Arrivals
from structgstream.data.live.outlets import QueueStatus


@dataclass(frozen=True)
class CameraStatus:
    """A camera.

    Args:
        present: whether it sent a usable picture a moment ago.
        decoded: pictures that were decoded.
        queued: pictures that wait to be matched.
        faults: kind to number.
    """

    present: bool = False
    decoded: int = 0
    queued: int = 0
    faults: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class SetAges:
    """How old the pictures of a frame were, in seconds from when they were filmed; None where that is not known.

    Args:
        arrived_seconds: when the last of them came.
        matched_seconds: when their set was ready.
        handed_seconds: when the frame was handed to the trainer.
    """

    arrived_seconds: float | None
    matched_seconds: float | None
    handed_seconds: float


@dataclass(frozen=True)
class LiveStatus:
    """All of them.

    Args:
        cameras: by name.
        sets: of pictures that were matched.
        small_sets: of them, with too few training cameras for a frame.
        skipped_sets: of them, no frame was made because there was a newer one, or no room.
        waiting_sets: of them, wait for the trainer.
        waiting_bytes: of the files they wait in.
        handed_per_second: frames handed to the trainer.
        arrived_seconds: from filming until the last picture came, of the frame handed out last; None before the first.
        matched_seconds: of that frame, from filming until its set was ready.
        delay_seconds: of that frame, from filming to handing out.
    """

    cameras: Mapping[str, CameraStatus]
    sets: int = 0
    small_sets: int = 0
    skipped_sets: int = 0
    waiting_sets: int = 0
    waiting_bytes: int = 0
    handed_per_second: float = 0.0
    arrived_seconds: float | None = None
    matched_seconds: float | None = None
    delay_seconds: float | None = None

    @classmethod
    def of(
        cls,
        arrivals: Arrivals | None,
        queue: QueueStatus | None,
        *,
        faults: Mapping[str, Mapping[str, int]],
        cameras: tuple[str, ...],
        handed_per_second: float,
        ages: SetAges | None,
    ) -> "LiveStatus":
        """The status of a source, whose cameras may not have been opened yet."""
        if arrivals is None or queue is None:
            return cls({name: CameraStatus(faults=faults.get(name, {})) for name in cameras})
        present, lengths = arrivals.present, arrivals.lengths
        return cls(
            {
                name: CameraStatus(name in present, feed.decoded, lengths[name], faults.get(name, {}))
                for name, feed in arrivals.feeds.items()
            },
            arrivals.sets,
            arrivals.small,
            queue.skipped,
            queue.waiting,
            queue.waiting_bytes,
            handed_per_second,
            None if ages is None else ages.arrived_seconds,
            None if ages is None else ages.matched_seconds,
            None if ages is None else ages.handed_seconds,
        )
