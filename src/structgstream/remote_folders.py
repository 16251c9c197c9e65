# SPDX-License-Identifier: Apache-2.0
"""Folders behind a URL, through fsspec and the package of its scheme; and addresses as messages may show them."""

import re
from typing import Any

from structgstream.errors import MissingExtraError, StorageError

HIDDEN = "***"
"""What messages show in the place of a secret."""
_SCHEME = re.compile(r"([a-z][a-z0-9+.-]*://)", re.IGNORECASE)
_ADDRESS = re.compile(rf"{_SCHEME.pattern}[^\s'\"<>]+", re.IGNORECASE)
_NAMED = re.compile(
    r"((?:^|[?&;/_,\s'\"{])[\w.-]*(?:user|login|pass|pwd|pw|psw|secret|token|key|auth|sig|cred|session)[\w.-]*?['\"]?\s*[=:]\s*"
    r"['\"]?)[^&;#\s'\"]+",
    re.IGNORECASE,
)
_PLAIN = {"channel", "subtype", "stream", "resolution", "fps", "transport", "profile", "camera", "unicast", "proto"}
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
        reason = reason_of(error, url)
        raise StorageError(f"{shown_address(url)} cannot be used as a store ({reason}).") from error


def reason_of(error: Exception, *addresses: str) -> str:
    """What a file system says, on one line, not too long, and without the secrets of these addresses."""
    said = without_secrets(str(error), *addresses)
    return " ".join(said.split())[:_LONGEST_REASON] or type(error).__name__


def shown_address(address: str) -> str:
    """An address without user and password, and without values in it that may be secret, for messages.

    Also a password that should have been escaped is left out: one with ``@``, ``/``, ``?`` or ``#``.
    """
    scheme, rest = "", address
    if (match := _SCHEME.match(address)) is not None:
        scheme, rest = match[0], address[match.end() :]
        authority = re.split(r"[/?#]", rest, maxsplit=1)[0]
        if "@" in authority and "@" not in re.split(r"[?#]", rest.replace("/", "?"), maxsplit=1)[-1]:
            rest = rest[authority.rindex("@") + 1 :]
        elif "@" in authority or (":" in authority and "@" in rest):
            rest = rest[rest.rindex("@") + 1 :]
    path, mark, query = rest.partition("?")
    pairs = (pair.partition("=") for pair in re.split(r"[&;]", query))
    query = "&".join(
        f"{name}={value if name.lower() in _PLAIN else HIDDEN}" if equals else HIDDEN for name, equals, value in pairs
    )
    return scheme + _NAMED.sub(rf"\1{HIDDEN}", path) + (mark and mark + query)


def without_secrets(text: str, *addresses: str) -> str:
    """A text for a message or a log, with all addresses in it as :func:`shown_address` has them.

    Args:
        text: such as what FFmpeg says of an error.
        addresses: that it may have, whatever characters their passwords have.
    """
    for address in sorted(filter(None, addresses), key=len, reverse=True):
        text = text.replace(address, shown_address(address))
    return _NAMED.sub(rf"\1{HIDDEN}", _ADDRESS.sub(lambda match: shown_address(match[0]), text))
