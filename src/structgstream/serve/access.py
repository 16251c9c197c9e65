# SPDX-License-Identifier: Apache-2.0
"""Access tokens, ``v1.EXPIRES.SIGNATURE.STREAM``, and the check of a request's token.

Note [Tokens]
~~~~~~~~~~~~~
EXPIRES is in Unix seconds; STREAM is the name of a stream, or ``~`` for every stream and the metrics. SIGNATURE is the
HMAC-SHA256 of both under the secret, in base64 without padding. Tokens are not stored: the secret is sufficient to
check one. A token cannot be revoked, so it should expire soon; all tokens of a secret become invalid when the server
is started without it. All characters can be used in a query and in a header without escapes.
"""

import base64
import hashlib
import hmac
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Final

from structgstream.errors import ConfigError
from structgstream.serve.streams import is_stream_name

if TYPE_CHECKING:
    from starlette.requests import Request

EVERY_STREAM: Final = "~"
MIN_SECRET_BYTES: Final = 32

_TOKEN = re.compile(r"v1\.([0-9]{1,12})\.([A-Za-z0-9_-]{43})\.([A-Za-z0-9._~-]{1,128})", re.ASCII)
_CONTEXT = b"structgstream access token v1\0"


class Access(Enum):
    """The result of checking a token for a stream; of a refusal, its sentence."""

    GRANTED = ""
    MISSING = "An access token is needed here."
    FORGED = "The access token is not one of this server."
    EXPIRED = "The access token has expired."
    OTHER_STREAM = "The access token is for another stream."


@dataclass(frozen=True)
class TokenKeys:
    """Secrets. The first one signs and all are accepted, so a secret can be replaced while its tokens are valid."""

    secrets: tuple[bytes, ...]

    def token(self, stream: str, *, expires_unix_seconds: int) -> str:
        """A token for ``stream``, or for every stream with :data:`EVERY_STREAM`. Raises ConfigError if no stream can
        have this name."""
        if stream != EVERY_STREAM and not is_stream_name(stream):
            raise ConfigError(
                f"{stream!r} is no name of a stream; expected letters, digits, dots, dashes and underscores."
            )
        return f"v1.{expires_unix_seconds}.{_signature(self.secrets[0], expires_unix_seconds, stream)}.{stream}"

    def access(self, token: str | None, stream: str, *, unix_seconds: float) -> Access:
        """Check ``token`` for a stream at a time; its other parts are parsed only if the signature is valid."""
        if not token:
            return Access.MISSING
        found = _TOKEN.fullmatch(token)
        if found is None:
            return Access.FORGED
        expires, signature, name = int(found[1]), found[2].encode(), found[3]
        # All secrets are tried, so that the time does not depend on which one signed.
        right = [hmac.compare_digest(signature, _signature(key, expires, name).encode()) for key in self.secrets]
        if not any(right):
            return Access.FORGED
        if unix_seconds >= expires:
            return Access.EXPIRED
        return Access.GRANTED if name in (stream, EVERY_STREAM) else Access.OTHER_STREAM


def _signature(secret: bytes, expires: int, stream: str) -> str:
    digest = hmac.digest(secret, _CONTEXT + f"{expires}\0{stream}".encode("ascii"), hashlib.sha256)
    return base64.urlsafe_b64encode(digest).rstrip(b"=").decode()


def read_keys(path: Path) -> TokenKeys:
    """The secrets of a file, one a line. Raises ConfigError if the file cannot be read, has no secret, or one that can
    be guessed."""
    advice = f"make one with: (umask 077; openssl rand -hex 32 > {path})"
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"The secret file {path} cannot be read ({error.strerror}); {advice}.") from None
    secrets = tuple(line.strip() for line in content.splitlines() if line.strip())
    if not secrets:
        raise ConfigError(f"The secret file {path} is empty; {advice}.")
    short = min(map(len, secrets))
    if short < MIN_SECRET_BYTES:
        raise ConfigError(
            f"A secret in {path} has {short} characters, and at least {MIN_SECRET_BYTES} are needed; {advice}."
        )
    return TokenKeys(secrets)


_BEARER = re.compile(r"bearer +([A-Za-z0-9._~+/-]+=*)", re.ASCII | re.IGNORECASE)


class Refused(Exception):
    """A request is refused; has the response's status, sentence and headers."""

    def __init__(self, status: int, text: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(text)
        self.status, self.text, self.headers = status, text, headers or {}


def token_of(request: "Request") -> str | None:
    """The token of a request: the one in its header ``Authorization``, else in its query; None if there is none."""
    bearer = _BEARER.fullmatch(request.headers.get("authorization", ""))
    return bearer[1] if bearer else request.query_params.get("token")


class Authorizer:
    """Checks the tokens of requests; without keys everyone has access."""

    def __init__(self, keys: TokenKeys | None, *, clock: Callable[[], float] = time.time) -> None:
        self._keys = keys
        self._clock = clock

    def access(self, request: "Request", name: str) -> Access:
        """Access of a request to the stream ``name``."""
        if self._keys is None:
            return Access.GRANTED
        return self._keys.access(token_of(request), name, unix_seconds=self._clock())

    def check(self, request: "Request", name: str) -> None:
        """Check that a request has access to the stream ``name``. Raises Refused if it has none."""
        if (access := self.access(request, name)) is not Access.GRANTED:
            raise refusal(access)

    def page_query(self, request: "Request") -> str:
        """The query that a page adds to the addresses it loads: the token of its own request, if one is needed."""
        token = token_of(request)
        return f"?token={token}" if self._keys is not None and token else ""


def refusal(access: Access) -> Refused:
    """The answer to a request without access."""
    if access is Access.OTHER_STREAM:
        return Refused(403, access.value)
    return Refused(401, access.value, {"WWW-Authenticate": 'Bearer realm="structgstream"'})
