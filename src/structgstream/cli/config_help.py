# SPDX-License-Identifier: Apache-2.0
"""The fields of the configuration as one line each: ``reconstruct --help-config``."""

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

COLUMN = 52
"""Where sentences begin; after longer values, two blanks behind them."""


def config_lines(config: Any, *, width: int | None = None) -> list[str]:
    """A line for each field of a configuration: its option, its value, and its first sentence.

    Args:
        config: a dataclass of dataclasses.
        width: columns; longer lines are cut. None for no limit.
    """
    lines = [f"{option:<{COLUMN - 2}}  {sentence}" for option, sentence in _rows(config, "--")]
    return [line if width is None or len(line) <= width else f"{line[: width - 1]}…" for line in lines]


def _rows(config: Any, prefix: str) -> Iterator[tuple[str, str]]:
    """Option with value, and sentence, of each field; those of nested configurations after it."""
    sentences, nested = first_sentences(type(config)), []
    for field in fields(config):
        value, option = getattr(config, field.name), f"{prefix}{field.name.replace('_', '-')}"
        if is_dataclass(value):
            nested.append((value, f"{option}."))
        else:
            yield f"{option} {_shown(value)}", sentences.get(field.name, "")
    for value, option in nested:
        yield from _rows(value, option)


def _shown(value: Any) -> str:
    if isinstance(value, frozenset):
        return " ".join(sorted(value))
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def first_sentences(kind: type) -> dict[str, str]:
    """The first sentence of the docstring below each field of a class and of its bases."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        assert isinstance(body, ast.ClassDef)
        for item, after in zip(body.body, body.body[1:], strict=False):
            match item, after:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    plain = re.sub(r":\w+:|`", "", " ".join(text.split()))
                    found[name] = re.split(r"(?<=\.) (?=[A-Z0-9])", plain)[0]
                case _:
                    pass
    return found
