# SPDX-License-Identifier: Apache-2.0
"""What examples a property is tried on.

An ordinary run takes a tenth of them, the same ones every time, so that it fails for what has changed and for nothing
else. With ``STRUCTGSTREAM_THOROUGH`` set all are taken, and others in every run, which finds what nobody thought of.
"""

import os
from collections.abc import Sequence
from typing import TypeVar

from hypothesis import settings

T = TypeVar("T")

THOROUGH = bool(os.environ.get("STRUCTGSTREAM_THOROUGH"))


def examples(count: int) -> settings:
    """``count`` of them in a thorough run, and never fewer than eight; no single one is timed."""
    return settings(deadline=None, max_examples=count if THOROUGH else max(count // 10, 8), derandomize=not THOROUGH)


def use_for_all() -> None:
    """Makes a hundred examples what a property takes that names no number, and all else what it is for others."""
    settings.register_profile("suite", parent=examples(100))
    settings.load_profile("suite")


def thinned(cases: Sequence[T]) -> list[T]:
    """Every fourth of the cases, with the first and the last of them; all in a thorough run."""
    return list(cases) if THOROUGH else [*cases[:-1:4], *cases[-1:]]
