# SPDX-License-Identifier: Apache-2.0
"""Configurations with other constants than those of their classes."""

from dataclasses import fields
from typing import Any, TypeVar, cast

Config = TypeVar("Config")


def varied(config: Config, **constants: Any) -> Config:
    """``config`` with other values of the upper-case constants of its class."""
    kind = type(config)
    assert all(hasattr(kind, name) for name in constants)
    values = {item.name: getattr(config, item.name) for item in fields(config)}  # type: ignore[arg-type]
    return cast(Config, type(kind.__name__, (kind,), constants)(**values))
