# SPDX-License-Identifier: Apache-2.0
"""Hosted CI may do no more than read, and does not pass without a browser by accident."""

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def parsed(path: Path) -> dict[Any, Any]:
    yaml = pytest.importorskip("yaml", reason="PyYAML, of the extra dev, is not installed")
    return yaml.safe_load(path.read_text())


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_a_workflow_may_only_read_and_ends(path: Path) -> None:
    workflow = parsed(path)
    assert workflow["permissions"] == {"contents": "read"}
    assert workflow["concurrency"]["group"] == "${{ github.workflow }}-${{ github.ref }}"
    for job in workflow["jobs"].values():
        assert "permissions" not in job
        assert job["timeout-minutes"] <= 60
        for step in job["steps"]:
            assert ("run" in step) != ("uses" in step)
            if step.get("uses", "").startswith("actions/checkout@"):
                assert step["with"]["persist-credentials"] is False
            if step.get("uses", "").startswith("actions/setup-python@"):
                assert step["with"]["cache"] == "pip"


@pytest.mark.parametrize(
    ("settings", "status", "said"),
    [
        ({"CI": "true"}, 1, r"no Chromium .* leave these tests out with SKIP_BROWSER_TESTS=1"),
        ({"CI": "true", "SKIP_BROWSER_TESTS": "1"}, 0, "SKIPPED: the tests in a browser"),
        ({}, 0, "SKIPPED: the tests in a browser"),
    ],
    ids=["ci", "asked", "elsewhere"],
)
def test_ci_without_a_browser_fails_unless_it_is_asked_to_skip(
    tmp_path: Path, settings: dict[str, str], status: int, said: str
) -> None:
    """On a machine that has bash and little more, where nothing can be installed."""
    for name in ("bash", "dirname", "timeout"):
        (tmp_path / name).symlink_to(str(shutil.which(name)))
    for name, line in {"id": "echo 1000", "make": "echo made"}.items():
        (tmp_path / name).write_text(f"#!{shutil.which('bash')}\n{line}\n")
        (tmp_path / name).chmod(0o755)
    command = [str(tmp_path / "bash"), str(ROOT / ".ci" / "run")]
    ran = subprocess.run(command, capture_output=True, text=True, env={"PATH": str(tmp_path), **settings}, check=False)
    assert ran.returncode == status, ran.stderr
    assert re.search(said, " ".join([ran.stdout, ran.stderr]))
    assert ("made" in ran.stdout) == (status == 0)
