# SPDX-License-Identifier: Apache-2.0
"""Folders at URLs, through fsspec and the package of a URL's scheme, and addresses without secrets for messages."""

import re
from typing import Any

from structgstream.errors import MissingExtraError, StorageError, import_extra

HIDDEN = "***"
"""Replacement of a secret in messages."""
_SCHEME = re.compile(r"([a-z][a-z0-9+.-]*://)", re.IGNORECASE)
_ADDRESS = re.compile(rf"{_SCHEME.pattern}[^\s'\"<>]+", re.IGNORECASE)
_NAMED = re.compile(
    r"((?:^|[?&;/_,\s'\"{])[\w.-]*(?:user|login|pass|pwd|pw|psw|secret|token|key|auth|sig|cred|session)[\w.-]*?['\"]?\s*[=:]\s*"
    r"['\"]?)[^&;#\s'\"]+",
    re.IGNORECASE,
)
_PLAIN = {"channel", "subtype", "stream", "resolution", "fps", "transport", "profile", "camera", "unicast", "proto"}
_LONGEST_REASON = 200  # characters; some services answer with whole pages


def open_url(url: str, **options: Any) -> tuple[Any, str]:
    """The file system of a URL in the syntax of fsspec, such as ``s3://bucket/streams/studio``, without a cache of
    listings, and the folder's path in it; ``options`` are the file system's, such as ``endpoint_url``.

    Raises MissingExtraError if fsspec, or the package for this scheme, is not installed, StorageError if the URL is not
    supported.
    """
    core = import_extra("fsspec.core", "cloud")
    try:
        return core.url_to_fs(url, use_listings_cache=False, **options)
    except ImportError as error:
        raise MissingExtraError(str(error.name or "s3fs"), "cloud") from None
    except Exception as error:  # Each file system has its own errors; all mean that it cannot be used.
        reason = reason_of(error, url)
        raise StorageError(f"{shown_address(url)} cannot be used as a store ({reason}).") from error


def reason_of(error: Exception, *addresses: str) -> str:
    """The message of a file system's error on one line, shortened, and without the secrets of these addresses."""
    message = without_secrets(str(error), *addresses)
    return " ".join(message.split())[:_LONGEST_REASON] or type(error).__name__


def shown_address(address: str) -> str:
    """An address for messages, without user, password and other values that may be secret.

    Removes also a password with ``@``, ``/``, ``?`` or ``#`` that should have been escaped.
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
    """A text for a message or a log, such as an error of FFmpeg, with :func:`shown_address` applied to all addresses in
    it, of which those given may have any characters in their passwords."""
    for address in sorted(filter(None, addresses), key=len, reverse=True):
        text = text.replace(address, shown_address(address))
    return _NAMED.sub(rf"\1{HIDDEN}", _ADDRESS.sub(lambda match: shown_address(match[0]), text))
