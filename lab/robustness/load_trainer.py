# SPDX-License-Identifier: Apache-2.0
"""Stands for a trainer: renders a scene so often a frame, as long as a fit takes, and writes a real packet as segments.

``python -m lab.robustness.load_trainer FOLDER STREAM --renderings N --log FILE`` runs until it is told to end by
SIGTERM. The packets are those of STREAM, over and over with rising numbers; a line of the log is a frame.
"""

import argparse
import json
import signal
import time
from itertools import count, cycle
from pathlib import Path
from typing import Any

import torch

from lab.robustness.stream_writers import renumbered
from structgstream.codec.packets import Packet
from structgstream.codec.reader import StreamReader, open_stream
from structgstream.codec.segments.sink import SegmentsSink
from structgstream.codec.segments.store import FolderStore
from structgstream.kernels.backend import cpu_backend
from structgstream.scene.render import render


def packets(reader: StreamReader) -> list[Packet]:
    """All packets of a stream, in order."""
    return [[*reader.group(index)][-1] for index in range(len(reader))]


def waited_seconds() -> float:
    """How long this thread was ready and had no core, since it began (Linux)."""
    return int(Path("/proc/thread-self/schedstat").read_text().split()[1]) / 1e9


def main() -> None:
    """Trains, in a manner of speaking."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("stream", type=Path)
    parser.add_argument("--renderings", type=int, default=10)
    parser.add_argument("--log", type=Path, required=True)
    options = parser.parse_args()
    ended = False

    def end(*signal_and_frame: Any) -> None:
        nonlocal ended
        ended = True

    signal.signal(signal.SIGTERM, end)
    store = FolderStore(options.folder)
    store.prepare()
    backend, sink = cpu_backend(), SegmentsSink(store, overwrite=True)
    torch.set_num_threads(1)
    with open_stream(options.stream) as reader, options.log.open("w") as log:
        scene, header = reader.scene(len(reader) - 1), reader.header
        cameras = [header.camera(name) for name in header.rig.training]
        sink.open(header)
        for index, packet in zip(count(), cycle(packets(reader)), strict=False):
            if ended:
                break
            began, worked, waited = time.monotonic(), time.process_time(), waited_seconds()
            for step in range(options.renderings):
                render(scene, cameras[step % len(cameras)], backend)
            fitted = time.monotonic()
            sink.write(renumbered(packet, index, fps=header.fps))
            line = {"began": began, "fit_seconds": fitted - began, "write_seconds": time.monotonic() - fitted}
            line["busy_seconds"], line["waited_seconds"] = time.process_time() - worked, waited_seconds() - waited
            log.write(json.dumps(line) + "\n")
            log.flush()
        sink.close()


if __name__ == "__main__":
    main()
