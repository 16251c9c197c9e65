# SPDX-License-Identifier: Apache-2.0
"""What studies raise on purpose, in the tree of ``structgstream.errors``."""

from structgstream.errors import StructGStreamError


class ExperimentError(StructGStreamError):
    """Steps of a sweep failed; what the others gave is stored."""
