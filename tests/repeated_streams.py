# SPDX-License-Identifier: Apache-2.0
"""Small streams for the benchmarks that send one again and again."""

from benchmarks.stream_writers import Sent, repeated

from segment_streams import as_file, packets
from structgstream.codec.reader import StreamReader


def small_sent(frames: int) -> Sent:
    """A stream of ``frames`` packets, which are six small ones again and again."""
    return repeated(StreamReader(as_file(packets(6)), name="small"), frames=frames)
