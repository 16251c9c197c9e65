# SPDX-License-Identifier: Apache-2.0
"""Segments in an object store, or on whatever else fsspec reaches by a URL."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.store import is_ours
from structgstream.errors import StorageError, StreamError
from structgstream.remote_folders import open_url, reason_of, shown_address

IMMUTABLE = "public, max-age=31536000, immutable"
"""Cache-Control of everything but the manifest."""
ALWAYS_ASK = "no-cache"
"""Cache-Control of the manifest."""
_ATOMIC = ("s3", "s3a", "gcs", "gs", "abfs", "az", "adl", "memory")


class CloudStore:
    """A folder of a URL such as ``s3://bucket/streams/studio``.

    Object stores write an object in one step and durably. Elsewhere (sftp and the like) a file is written under a
    temporary name and moved. S3 gets content types and cache headers, so that the bucket can be read by browsers.

    Args:
        url: the folder.
        options: of the file system, as fsspec takes them, such as ``endpoint_url`` of an S3 that is not Amazon's.

    Raises:
        MissingExtraError: fsspec, or the package for this scheme, is not installed.
        StorageError: the URL is not understood.
    """

    def __init__(self, url: str, **options: Any) -> None:
        self._url = url.rstrip("/")
        self.name = shown_address(self._url)
        self._files, self._root = open_url(self._url, **options)
        protocols = self._files.protocol
        self._scheme = protocols if isinstance(protocols, str) else protocols[0]

    def put(self, name: str, data: bytes) -> None:
        """See ``Store.put``."""
        path = f"{self._root}/{name}"
        with self._writing(f"write {len(data)} bytes to {name}"):
            if self._scheme in _ATOMIC:
                self._files.pipe_file(path, data, **self._headers(name))
            else:
                temporary = f"{self._root}/.new-{name}"
                self._files.makedirs(self._root, exist_ok=True)
                self._files.pipe_file(temporary, data)
                self._files.mv(temporary, path)

    def get(self, name: str, *, most_bytes: int | None = None) -> bytes:
        """See ``Store.get``."""
        end = None if most_bytes is None else most_bytes + 1
        try:
            data = self._files.cat_file(f"{self._root}/{name}", end=end)
        except Exception as error:
            raise StreamError(f"Cannot read {name} in {self.name} ({reason_of(error, self._url)}).") from error
        if most_bytes is not None and len(data) > most_bytes:
            raise StreamError(f"{name} in {self.name} has more than the expected {most_bytes} bytes.")
        return data

    def delete(self, name: str) -> None:
        """See ``Store.delete``."""
        with self._writing(f"remove {name}"):
            try:
                self._files.rm_file(f"{self._root}/{name}")
            except FileNotFoundError:
                return

    def names(self) -> frozenset[str]:
        """See ``Store.names``."""
        try:
            self._files.invalidate_cache()
            found = self._files.ls(self._root, detail=False)
        except FileNotFoundError:
            return frozenset()
        except Exception as error:
            raise StreamError(f"Cannot list {self.name} ({reason_of(error, self._url)}).") from error
        return frozenset(filter(is_ours, (str(path).rsplit("/", 1)[-1] for path in found)))

    def free_bytes(self) -> int | None:
        """Object stores do not say."""
        return None

    def _headers(self, name: str) -> dict[str, str]:
        if not self._scheme.startswith("s3"):
            return {}
        kind = "application/json" if name.endswith(".json") else "application/octet-stream"
        return {"ContentType": kind, "CacheControl": ALWAYS_ASK if name == MANIFEST else IMMUTABLE}

    @contextmanager
    def _writing(self, what: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            raise StorageError(f"Cannot {what} in {self.name} ({reason_of(error, self._url)}).") from error
