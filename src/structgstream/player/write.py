# SPDX-License-Identifier: Apache-2.0
"""A stream file as a page that opens from a disk, or as a folder for any web server."""

from pathlib import Path

from structgstream.errors import StorageError
from structgstream.player.bundle import bundle
from structgstream.player.page import linked_page, single_page
from structgstream.player.stream_file import StreamFile, check_has_header, pieces
from structgstream.whole_files import write_whole


def write_page(path: Path, stream: StreamFile) -> int:
    """Writes one HTML page that contains the player and the stream at its present length.

    Returns:
        Bytes of the page.

    Raises:
        PlayerError: the stream is too long for a page, or the installation lacks the player.
        StreamError: no frame of the stream can be decoded.
        StorageError: the page cannot be written.
    """
    with stream.opened() as data:
        check_has_header(data, str(stream.path))
        page = single_page(stream.path.stem, module=bundle(), stream=data)
    write_whole(path, page, new_folder=True)
    return len(page)


def write_site(folder: Path, stream: StreamFile) -> int:
    """Writes ``index.html``, ``player.js`` and ``stream.sgs`` into a folder; a web server needs nothing else.

    Returns:
        Bytes of the three files.

    Raises:
        PlayerError: the installation lacks the player.
        StreamError: no frame of the stream can be decoded.
        StorageError: a file cannot be written, or would replace the stream itself.
    """
    stream.check()
    copy = folder / "stream.sgs"
    if copy.exists() and copy.samefile(stream.path):
        raise StorageError(f"{copy} is the stream itself; name another folder.")
    small = {
        "index.html": linked_page(stream.path.stem, stream="stream.sgs").encode(),
        "player.js": bundle().encode(),
    }
    for name, content in small.items():
        write_whole(folder / name, content, new_folder=True)
    with stream.opened() as data:
        write_whole(copy, pieces(data, range(len(data))), new_folder=True)
        return sum(map(len, small.values())) + len(data)
