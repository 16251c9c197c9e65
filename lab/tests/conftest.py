# SPDX-License-Identifier: Apache-2.0
"""The tests of the laboratory share fixtures and settings with those of the package."""

from tests.conftest import pytest_collection_modifyitems, pytest_configure, pytest_unconfigure, quiet_randomness

__all__ = ["pytest_collection_modifyitems", "pytest_configure", "pytest_unconfigure", "quiet_randomness"]
