# SPDX-License-Identifier: Apache-2.0
"""The machine and its load, for whoever reads the numbers later."""

import os
from typing import Any

from structgstream.evaluation.environment import environment
from structgstream.kernels._load import instruction_set, native_reason


def machine() -> dict[str, Any]:
    """Processor, cores, instruction set of the kernels, versions and commit."""
    return {**environment(), "instruction_set": None if native_reason() else instruction_set()}


def load_average() -> list[float] | None:
    """Mean number of running processes over 1, 5 and 15 minutes; None where the system does not tell."""
    return [round(value, 2) for value in os.getloadavg()] if hasattr(os, "getloadavg") else None
