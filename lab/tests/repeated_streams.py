# SPDX-License-Identifier: Apache-2.0
"""Small streams for the benchmarks that send one again and again."""

from lab.robustness.stream_writers import Sent, repeated
from structgstream.codec.reader import StreamReader
from tests.support.segment_streams import as_file, packets


def small_sent(frames: int, *, each_a_period: bool = False) -> Sent:
    """A stream of ``frames`` packets, which are six small ones again and again, each time in another period or not."""
    return repeated(StreamReader(as_file(packets(6)), name="small"), frames=frames, each_a_period=each_a_period)
