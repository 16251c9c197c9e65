# SPDX-License-Identifier: Apache-2.0
"""A stream of segments as one stream file."""

from pathlib import Path

from structgstream.codec.segments.store import Store
from structgstream.codec.segments.stored_bytes import StoredBytes, read_manifest
from structgstream.errors import StreamError
from structgstream.whole_files import write_whole


def write_archive(store: Store, path: Path) -> int:
    """Write the bytes that the file sink would have written, and return how many frames they hold.

    The SHA-256 of every file is verified on the way; an existing file at ``path`` is replaced only by a whole archive.
    A run that has not ended gives a file without an index, which may be continued with ``--resume``.

    Raises:
        StreamError: frames have left the window, or a file is missing or damaged.
        StorageError: the file cannot be written.
    """
    stored = StoredBytes(store, read_manifest(store), check=True)
    if stored.gone:
        gone = " and ".join(f"{frames.start} to {frames.stop - 1}" for frames in stored.gone)
        raise StreamError(
            f"{store.name} is not whole: frames {gone} have left its window (--window). A stream file has no gaps; "
            "reconstruct without a window to archive a whole stream."
        )
    write_whole(path, stored.files())
    return len(stored.sizes)
