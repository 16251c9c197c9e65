# SPDX-License-Identifier: Apache-2.0
"""Modules that lie outside of any package: the cameras of ``tests/support/senders``, the browser of the tests."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[2]


def senders() -> ModuleType:
    """``tests/support/senders/send.py``."""
    return _from(ROOT / "tests" / "support" / "senders", "send")


def chromium() -> ModuleType:
    """``tests/support/chromium.py``, which needs pytest."""
    return _from(ROOT, "tests.support.chromium")


def _from(folder: Path, name: str) -> ModuleType:
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
    return importlib.import_module(name)
