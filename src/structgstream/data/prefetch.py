# SPDX-License-Identifier: Apache-2.0
"""Decodes the next frames in the background while one is trained."""

from collections.abc import Iterator
from dataclasses import dataclass

from structgstream.data.source import FrameStream, is_recording
from structgstream.data.wrappers import SourceWrapper
from structgstream.errors import ConfigError
from structgstream.frames import MultiViewFrame
from structgstream.lookahead import Lookahead


@dataclass(frozen=True)
class Prefetch(SourceWrapper):
    """The same frames, decoded ahead in a background thread; results are unchanged.

    Args:
        source: the capture.
        depth: number of frames decoded ahead, at least 1; each costs its pictures' bytes.
    """

    depth: int = 2

    def __post_init__(self) -> None:
        if self.depth < 1:
            raise ConfigError(f"Prefetch needs a depth of at least 1, got {self.depth}.")

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        """The frames from stream index ``start``.

        An error of the source is raised in place of the frame that it concerns. Closing the iterator, or an
        exception in its consumer, ends the thread within the decoding of one frame.
        """
        with Lookahead(self.source.frames(start), depth=self.depth) as frames:
            yield from frames

    def frames_behind(self) -> Iterator[MultiViewFrame]:
        return self.source.frames_behind() if isinstance(self.source, SourceWrapper) else iter(())


def read_ahead(source: FrameStream) -> FrameStream:
    """A recording decoded ahead; a live source, which has threads and queues of its own, as it is."""
    return Prefetch(source) if is_recording(source) else source
