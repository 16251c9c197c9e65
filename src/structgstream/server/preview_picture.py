# SPDX-License-Identifier: Apache-2.0
"""Renders a stream's preview and writes it as PNG to the standard output: a program that the server starts.

``python -m structgstream.server.preview_picture ROOT NAME KIND``
"""

import os
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.container.byte_source import ByteSlice, ByteSource
from structgstream.codec.container.payload import parse_packet
from structgstream.codec.container.records import PREFIX, RecordType, check_prefix, footer_offset, read_record
from structgstream.codec.decoder import SceneDecoder
from structgstream.codec.header import unpack_header
from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.codec.reader import StreamReader
from structgstream.codec.segments.manifest import MANIFEST, Manifest
from structgstream.codec.segments.manifest_json import MOST_MANIFEST_BYTES, manifest_from_json
from structgstream.errors import StreamError, StructGStreamError
from structgstream.evaluation.png import png_bytes
from structgstream.kernels.backend import select_backend
from structgstream.scene.render import render, to_8bit_image
from structgstream.server.catalog import ServedStream, StreamKind

WIDTH = 320
MOST_BYTES = 256 * 10**6
"""Of an init record or a key packet."""


def preview(stream: ServedStream) -> bytes:
    """The PNG of a key frame: the newest of segments, one from the middle of a finished file, else the first.

    Raises:
        StreamError: no frame can be decoded.
    """
    if stream.kind is StreamKind.SEGMENTS:
        manifest = manifest_from_json(_read(stream, MANIFEST, most=MOST_MANIFEST_BYTES), name=stream.name)
        init, key = _newest(stream, manifest)
        return png_bytes(picture(init, key))
    opened = stream.open_whole()
    if opened is None:
        raise StreamError(f"{stream.name} is gone.")
    with opened as data:
        if footer_offset(data) is not None:
            with StreamReader(data, name=stream.name, by_index=True) as reader:
                return png_bytes(_middle(reader))
        check_prefix(data, stream.name)
        init = read_record(data, PREFIX.size)
        if init is None:
            raise StreamError(f"{stream.name} has no whole header.")
        return png_bytes(picture(data[: init.end], ByteSlice(data, init.end, len(data))))


def _middle(reader: StreamReader) -> NDArray[np.uint8]:
    """The key frame at or before the middle of a finished stream."""
    index = len(reader) // 2
    while index and reader.packets.at(index).kind is not PacketKind.KEY:
        index -= 1
    name, width, height = _view(reader.header)
    return reader.render(index, reader.header.rig[name].resized(width, height), backend="auto")


def picture(init: ByteSource, key: ByteSource) -> NDArray[np.uint8]:
    """``[H, W, 3]``: a key packet from the middle one of the training cameras.

    Args:
        init: prefix and init record.
        key: begins with the record of a key packet.

    Raises:
        StreamError: they are not what is expected.
    """
    check_prefix(init, "The stream")
    head, record = read_record(init, PREFIX.size), read_record(key, 0)
    if head is None or head.type != RecordType.INIT or record is None or record.type != RecordType.KEY:
        raise StreamError("The stream has no whole key packet.")
    header = unpack_header(head.payload)
    scene = SceneDecoder(header).decode(parse_packet(record.payload, PacketKind.KEY))
    name, width, height = _view(header)
    view = header.camera(name).resized(width, height)
    return to_8bit_image(render(scene, view, select_backend("auto")).image)


def _view(header: StreamHeader) -> tuple[str, int, int]:
    """The training camera in the middle of the rig's order, and the size of a small picture of it."""
    name = header.rig.training[len(header.rig.training) // 2]
    camera = header.rig[name]
    width = min(WIDTH, camera.width)
    return name, width, max(round(camera.height * width / camera.width), 1)


def _newest(stream: ServedStream, manifest: Manifest) -> tuple[bytes, bytes]:
    """The init record and the key packet of the newest group."""
    if manifest.parts and manifest.parts[0].kind is PacketKind.KEY:
        entry, file, count = manifest.parts[0], manifest.parts[0].file, manifest.parts[0].bytes
    elif manifest.segments:
        entry, file, count = manifest.segments[-1], manifest.segments[-1].file, manifest.segments[-1].key_bytes
    else:
        raise StreamError(f"{stream.name} has no key packet yet.")
    period = next((one for one in manifest.periods if one.period == entry.period), None)
    if period is None:  # A manifest need not name the period of a segment that has left its window.
        raise StreamError(f"{stream.name} has no key packet in its window.")
    return _read(stream, period.file, most=period.bytes), _read(stream, file, most=count)


def _read(stream: ServedStream, file: str, *, most: int) -> bytes:
    """The first ``most`` bytes of a file of a segments folder."""
    opened = stream.open(file) if most <= MOST_BYTES else None
    if opened is None:
        raise StreamError(f"{stream.name} has no {file}, or one that is too large for a preview.")
    with opened:
        return opened.read(0, min(most, len(opened)))


def main(arguments: list[str]) -> int:
    """Renders, with a low priority; returns the exit status."""
    os.nice(10)
    root, name, kind = arguments
    try:
        content = preview(ServedStream(Path(root), name, StreamKind(kind)))
    except StructGStreamError as error:
        print(error, file=sys.stderr)
        return 1
    sys.stdout.buffer.write(content)
    sys.stdout.buffer.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
