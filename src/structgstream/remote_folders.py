# SPDX-License-Identifier: Apache-2.0
"""Folders behind a URL, such as of an object store, through fsspec and the package of the URL's scheme."""

from typing import Any

from structgstream.errors import MissingExtraError, StorageError

_LONGEST_REASON = 200  # characters; some services answer with pages


def open_url(url: str, **options: Any) -> tuple[Any, str]:
    """The file system of a URL, without a cache of listings, and the folder's path in it.

    Args:
        url: as fsspec takes it, such as ``s3://bucket/streams/studio``.
        options: of the file system, such as ``endpoint_url``.

    Raises:
        MissingExtraError: fsspec, or the package for this scheme, is not installed.
        StorageError: the URL is not understood.
    """
    try:
        from fsspec.core import url_to_fs
    except ModuleNotFoundError:
        raise MissingExtraError("fsspec", "cloud") from None
    try:
        return url_to_fs(url, use_listings_cache=False, **options)
    except ImportError as error:
        raise MissingExtraError(str(error.name or "s3fs"), "cloud") from None
    except Exception as error:  # Each file system has its own; all mean that it cannot be used.
        raise StorageError(f"{url} cannot be used as a store ({reason_of(error)}).") from error


def reason_of(error: Exception) -> str:
    """What a file system says, on one line and not too long."""
    return " ".join(str(error).split())[:_LONGEST_REASON] or type(error).__name__
