# SPDX-License-Identifier: Apache-2.0
"""What a request says besides its path: the query, the token, and validators."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qsl

MOST_PARAMETERS: Final = 16
_NUMBER = re.compile(r"[0-9]{1,16}", re.ASCII)
_BEARER = re.compile(r"bearer +([A-Za-z0-9._~+/-]+=*)", re.ASCII | re.IGNORECASE)


class BadQuery(Exception):
    """The query is malformed; the message says how."""


@dataclass(frozen=True)
class Query:
    """What is understood of a query; the rest is ignored.

    Args:
        token: access token; None without.
        after: sequence that the client has already; None where it does not wait.
    """

    token: str | None
    after: int | None


def parsed_query(raw: bytes, headers: Mapping[str, str]) -> Query:
    """The query of a request, with the token from the header ``Authorization`` where there is one.

    Args:
        raw: as the client wrote it, without question mark.
        headers: by their names in lower case.

    Raises:
        BadQuery: it has too many parameters, one of them twice, or ``after`` is no number.
    """
    try:
        pairs = parse_qsl(raw.decode("ascii"), keep_blank_values=True, max_num_fields=MOST_PARAMETERS, errors="strict")
    except ValueError:  # also of what is no UTF-8
        raise BadQuery(f"The query cannot be read, or has more than {MOST_PARAMETERS} parameters.") from None
    values = dict(pairs)
    for name in ("token", "after"):
        if sum(key == name for key, _ in pairs) > 1:
            raise BadQuery(f"The query has {name} twice.")
    if not _NUMBER.fullmatch(values.get("after", "0")):
        raise BadQuery("The query's after is not a sequence number.")
    bearer = _BEARER.fullmatch(headers.get("authorization", ""))
    return Query(bearer[1] if bearer else values.get("token"), int(values["after"]) if "after" in values else None)


def knows(headers: Mapping[str, str], *etags: str) -> bool:
    """Whether ``If-None-Match`` names one of the validators, so that the client has the content already."""
    given = headers.get("if-none-match", "")
    names = {name.strip().removeprefix("W/") for name in given.split(",")}
    return given.strip() == "*" or not names.isdisjoint(etags)


def accepts_gzip(headers: Mapping[str, str]) -> bool:
    """Whether ``Accept-Encoding`` names gzip, and not with a weight of nought."""
    for entry in headers.get("accept-encoding", "").lower().split(","):
        name, _, weight = entry.replace(" ", "").partition(";")
        if name == "gzip":
            return not re.fullmatch(r"q=0(\.0*)?", weight)
    return False
