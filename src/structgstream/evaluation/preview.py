# SPDX-License-Identifier: Apache-2.0
"""A preview picture of a segmented stream, which ``structgstream serve`` shows in its list."""

from contextlib import suppress
from typing import Final

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.decoder import SceneDecoder
from structgstream.codec.packets import Packet, PacketKind, PacketSink, StreamHeader
from structgstream.codec.segments.store import Store
from structgstream.errors import StorageError
from structgstream.evaluation.pictures import png_bytes
from structgstream.kernels.backend import processor_backend
from structgstream.scene.render import render, to_8bit_image

PREVIEW: Final = "preview.png"
WIDTH: Final = 320


class PreviewSink:
    """Forwards a stream to ``sink``, and writes ``preview.png`` of each key frame to the same store.

    The picture is rendered on the CPU from the decoded packet, so that the run's GPU memory and random numbers do not
    change. A preview that cannot be written is skipped.

    Args:
        sink: receives the stream.
        store: receives the picture.
    """

    def __init__(self, sink: PacketSink, store: Store) -> None:
        self._sink = sink
        self._store = store
        self._header: StreamHeader | None = None

    def open(self, header: StreamHeader) -> int:
        self._header = header
        return self._sink.open(header)

    def begin(self, header: StreamHeader) -> int:
        self._header = header
        return self._sink.begin(header)

    def write(self, packet: Packet) -> int:
        size = self._sink.write(packet)
        if packet.kind is PacketKind.KEY and self._header is not None:
            with suppress(StorageError):
                self._store.put(PREVIEW, png_bytes(preview(self._header, packet)))
        return size

    def close(self) -> None:
        self._sink.close()


def preview(header: StreamHeader, packet: Packet) -> NDArray[np.uint8]:
    """A key frame ``[H, W, 3]`` (8-bit sRGB) from the middle training camera, at most 320 pixels wide.

    Args:
        header: header of the packet's period.
        packet: a key packet.
    """
    name = header.rig.training[len(header.rig.training) // 2]
    camera = header.rig[name]
    width = min(WIDTH, camera.width)
    view = header.camera(name).resized(width, max(round(camera.height * width / camera.width), 1))
    return to_8bit_image(render(SceneDecoder(header).decode(packet), view, processor_backend()).image)
