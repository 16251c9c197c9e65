# SPDX-License-Identifier: Apache-2.0
"""Fields of configurations, which are dataclasses of dataclasses: read from plain JSON, and checked."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields, is_dataclass
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from structgstream.errors import ConfigError

SIGNED = frozenset({"quality", "tiles_around"})
"""Fields that may be negative."""
SHARES = frozenset({"mean_of_last", "motion_prior", "picture_scale", "dropped_share", "occluded_share"})
"""Fields that are at most 1."""
POSITIVE = frozenset({"picture_scale", "key_interval_seconds"})
"""Fields that must not be 0."""
_KINDS: Mapping[Any, tuple[type, ...]] = {int: (int,), float: (int, float), bool: (bool,)}


def holds(found: Any, given: Any) -> bool:
    """Whether ``found`` has all that is ``given``."""
    if isinstance(given, list) and isinstance(found, list):
        return len(found) == len(given) and all(map(holds, found, given))
    if isinstance(given, dict) and isinstance(found, dict):
        return all((key == "period" and key not in found) or holds(found.get(key), item) for key, item in given.items())
    return (type(found) is type(given) and found == given) or (_is_number(found, given) and found == given)


def _is_number(*values: Any) -> bool:
    return all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)


def unknown_fields(kind: Any, values: Any, path: str = "") -> Iterator[str]:
    """Paths in ``values`` of fields that the dataclass ``kind`` lacks."""
    hints = get_type_hints(kind) if isinstance(kind, type) and is_dataclass(kind) else {}
    for name, item in values.items() if hints and isinstance(values, Mapping) else ():
        if name not in hints:
            yield f"{path}{name}"
        else:
            yield from unknown_fields(hints[name], item, f"{path}{name}.")


def plain_value(value: Any) -> Any:
    """``value``, of a configuration, as plain JSON values."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain_value(asdict(value))
    if isinstance(value, dict):
        return {key: plain_value(item) for key, item in value.items()}
    if isinstance(value, frozenset | set):
        return sorted(value)
    return [plain_value(item) for item in value] if isinstance(value, list | tuple) else value


def check_numbers(config: Any, path: str = "") -> None:
    """Check every number of a configuration and of those in it: finite, not negative, and within its bounds.

    Raises:
        ConfigError: naming the field by its path.
    """
    hints = get_type_hints(type(config))
    for item in fields(config):
        value, where = getattr(config, item.name), f"{path}{item.name}"
        if is_dataclass(value):
            check_numbers(value, f"{where}.")
        elif isinstance(value, tuple):
            for number in value:
                _check_number(number, item.name, where)
        elif hints[item.name] in _KINDS and type(value) not in _KINDS[hints[item.name]]:
            expected = {int: "a whole number", float: "a number", bool: "true or false"}[hints[item.name]]
            raise ConfigError(f"{where} is {value!r}; expected {expected}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            _check_number(value, item.name, where)


def _check_number(value: float, name: str, where: str) -> None:
    shares, positive = name in SHARES, name in POSITIVE
    least, most = (-math.inf if name in SIGNED else 0.0), (1.0 if shares else math.inf)
    if not math.isfinite(value) or not least <= value <= most or (positive and value == 0):
        start = "more than 0" if positive else "a finite number" if name in SIGNED else "0 or more"
        raise ConfigError(f"{where} is {value!r}; expected {start}{', and at most 1' if shares else ''}.")


def read_value(kind: Any, value: Any) -> Any:
    """``value``, plain JSON, as a ``kind``: a dataclass, a container, or what JSON has itself."""
    if isinstance(kind, type) and is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(**{name: read_value(hints[name], item) for name, item in value.items()})
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        (kind,) = (of for of in arguments if of is not type(None))
        return None if value is None else read_value(kind, value)
    if origin is tuple:
        return tuple(read_value(arguments[0], item) for item in value)
    return origin(value) if origin in (frozenset, dict) else value
