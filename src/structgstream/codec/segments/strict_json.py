# SPDX-License-Identifier: Apache-2.0
"""Reading JSON of a host that may be hostile: every value is checked for its type and bounds before it is used.

The player's reader (viewer/packages/player/src/source/checks.ts) follows the same rules, which docs/segments.md states:
`12.0` and `1.2e1` are whole numbers, what is not RFC 8259 is refused also where nobody asks for it, and so is a byte
order mark.
"""

import json
import re
from typing import Any, NoReturn

from structgstream.errors import StreamError

MOST = 1e15
"""The largest number where nothing else is said: beyond it seconds are no longer told apart."""

_FILE = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}", re.ASCII)
_SHA256 = re.compile(r"[0-9a-f]{64}", re.ASCII)


class Fields:
    """The fields of a JSON object; ``where`` names it in messages. Fields that nobody asks for are ignored.

    Raises:
        StreamError: every method, when the field is missing, of another type or beyond its bounds.
    """

    def __init__(self, value: object, where: str) -> None:
        self._where = where
        if not isinstance(value, dict):
            raise StreamError(f"{where} is {_shown(value)}; expected an object.")
        self._value: dict[str, Any] = value

    def is_none(self, name: str) -> bool:
        """Whether the field is there and null."""
        return self._get(name) is None

    def whole(self, name: str, *, least: int = 0, most: int = 2**32 - 1) -> int:
        """A whole number."""
        return self._whole(name, self._get(name), least, most)

    def wholes(self, name: str, *, count: int, least: int = 0, most: int = 2**32 - 1) -> tuple[int, ...]:
        """A list of ``count`` whole numbers."""
        values = self._get(name)
        if not isinstance(values, list) or len(values) != count:
            self._refuse(name, values, f"a list of {count} whole numbers")
        return tuple(self._whole(name, value, least, most) for value in values)

    def number(self, name: str, *, least: float = -MOST, most: float = MOST) -> float:
        """A finite number."""
        return self._number(name, self._get(name), least, most)

    def pair(self, name: str) -> tuple[float, float]:
        """Two finite numbers that do not fall."""
        values = self._get(name)
        if not isinstance(values, list) or len(values) != 2:
            self._refuse(name, values, "two numbers")
        first, last = (self._number(name, value, -MOST, MOST) for value in values)
        if first > last:
            self._refuse(name, values, "two numbers that do not fall")
        return first, last

    def text(self, name: str, *, most: int = 1000) -> str:
        """A text of at most ``most`` characters, which can be printed: JSON may hold halves of characters."""
        value = self._get(name)
        if not isinstance(value, str) or len(value) > most or any("\ud800" <= one <= "\udfff" for one in value):
            self._refuse(name, value, f"a text of at most {most} characters")
        return value

    def flag(self, name: str) -> bool:
        """True or false."""
        value = self._get(name)
        if not isinstance(value, bool):
            self._refuse(name, value, "true or false")
        return value

    def file(self, name: str = "file") -> str:
        """The plain name of a file beside the manifest: no folder, no scheme, no leading dot."""
        value = self._get(name)
        if not isinstance(value, str) or not _FILE.fullmatch(value):
            self._refuse(name, value, "the plain name of a file beside it (letters, digits, '.', '_' and '-')")
        return value

    def sha256(self, name: str = "sha256") -> str:
        """64 hex digits."""
        value = self._get(name)
        if not isinstance(value, str) or not _SHA256.fullmatch(value):
            self._refuse(name, value, "64 hex digits")
        return value

    def items(self, name: str, *, most: int) -> "list[Fields]":
        """A list of at most ``most`` objects."""
        values = self._get(name)
        if not isinstance(values, list) or len(values) > most:
            self._refuse(name, values, f"a list of at most {most} objects")
        return [Fields(value, f"{self._where}, {name}[{i}]") for i, value in enumerate(values)]

    def fields(self, name: str) -> "Fields":
        """An object."""
        return Fields(self._get(name), f"{self._where}, {name}")

    def refuse(self, reason: str) -> NoReturn:
        """Raise an error about this object."""
        raise StreamError(f"{self._where} {reason}.")

    def _get(self, name: str) -> Any:
        if name not in self._value:
            raise StreamError(f"{self._where} has no {name!r}.")
        return self._value[name]

    def _whole(self, name: str, value: Any, least: int, most: int) -> int:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not least <= value <= most or value != int(value):
            self._refuse(name, value, f"a whole number from {least} to {most}")
        return int(value)

    def _number(self, name: str, value: Any, least: float, most: float) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
            self._refuse(name, value, f"a number from {least:g} to {most:g}")
        return float(value)

    def _refuse(self, name: str, value: object, expected: str) -> NoReturn:
        raise StreamError(f"{self._where} has {name!r} {_shown(value)}; expected {expected}.")


def parse_object(data: bytes, where: str, *, max_bytes: int) -> Fields:
    """The JSON object in ``data``.

    Raises:
        StreamError: it is longer than ``max_bytes``, or not a JSON object.
    """
    if len(data) > max_bytes:
        raise StreamError(f"{where} has {len(data)} bytes; expected at most {max_bytes}.")
    try:
        value = json.loads(data.decode(), parse_int=_number, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise StreamError(f"{where} is not JSON ({error}).") from None
    return Fields(value, where)


def _number(text: str) -> int | float:
    """Python refuses to convert very many digits, which are a number nevertheless."""
    return int(text) if len(text) < 20 else float(text)


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"it holds {name}")


def _shown(value: object) -> str:
    try:
        text = json.dumps(value)
    except (ValueError, RecursionError):
        text = type(value).__name__
    return text if len(text) <= 60 else f"{text[:60]}..."
