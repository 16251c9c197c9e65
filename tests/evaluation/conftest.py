# SPDX-License-Identifier: Apache-2.0
"""What all tests of evaluation share."""

from pathlib import Path

import pytest

from structgstream.evaluation.lpips import ENVIRONMENT


@pytest.fixture(autouse=True)
def no_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The same answers on a machine that has weights of LPIPS."""
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub"))
