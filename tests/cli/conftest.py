# SPDX-License-Identifier: Apache-2.0
"""What tests of several commands share."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from structgstream.cli import main
from tests.support.quick_streams import CLIP, QUICK, SMALL, Runner, runner_of
from tests.support.shared_folder import made_once
from tests.support.small_presets import few_points


@pytest.fixture(scope="session")
def stream() -> Path:
    """Three frames of 80x60 pixels, hardly trained; nobody changes it."""
    return made_once("stream", _make_stream) / "clip.sgs"


def _make_stream(folder: Path) -> None:
    with few_points("tiny"):
        assert main(["reconstruct", CLIP, "-o", str(folder / "clip.sgs"), *SMALL, *QUICK]) == 0


@pytest.fixture(scope="module")
def quick_tiny() -> Iterator[None]:
    """The preset tiny with few initial points, also for what a module makes once for all its tests."""
    with few_points("tiny"):
        yield


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Runner:
    """Runs a command and returns what it has printed."""
    return runner_of(capsys)


@pytest.fixture
def quick_presets() -> Iterator[None]:
    """Presets with few initial points."""
    with few_points("tiny", "paper-meetroom"):
        yield
