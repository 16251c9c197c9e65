# SPDX-License-Identifier: Apache-2.0
"""How many examples a property is tried on: a quarter, or all of them with ``STRUCTGSTREAM_THOROUGH`` set."""

import os

from hypothesis import settings

THOROUGH = bool(os.environ.get("STRUCTGSTREAM_THOROUGH"))


def examples(count: int) -> settings:
    """``count`` of them in a thorough run, and never fewer than eight; no single one is timed."""
    return settings(deadline=None, max_examples=count if THOROUGH else max(count // 4, 8))
