# SPDX-License-Identifier: Apache-2.0
"""What tests of several commands share."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from structgstream.cli import main
from tests.support.quick_streams import CLIP, QUICK, SMALL
from tests.support.small_presets import few_points


@pytest.fixture(scope="session")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of 80x60 pixels, hardly trained; nobody changes it."""
    path = tmp_path_factory.mktemp("stream") / "clip.sgs"
    with few_points("tiny"):
        assert main(["reconstruct", CLIP, "-o", str(path), *SMALL, *QUICK]) == 0
    return path


@pytest.fixture(scope="module")
def quick_tiny() -> Iterator[None]:
    """The preset tiny with few initial points, also for what a module makes once for all its tests."""
    with few_points("tiny"):
        yield


@pytest.fixture
def quick_presets() -> Iterator[None]:
    """Presets with few initial points."""
    with few_points("tiny", "paper-meetroom"):
        yield
