# SPDX-License-Identifier: Apache-2.0
"""What hosted CI, pre-commit and make call exists, and hosted CI may do no more than read."""

import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
CALLERS = [*WORKFLOWS, ROOT / ".ci" / "run", ROOT / "Makefile", ROOT / ".pre-commit-config.yaml"]
CALLERS += sorted(path for path in (ROOT / "scripts").iterdir() if path.is_file())


def without_comments(path: Path) -> str:
    return "\n".join(line for line in path.read_text().splitlines() if not line.lstrip().startswith("#"))


def parsed(path: Path) -> dict[Any, Any]:
    yaml = pytest.importorskip("yaml", reason="PyYAML, of the extra dev, is not installed")
    return yaml.safe_load(path.read_text())


@pytest.mark.parametrize("path", CALLERS, ids=lambda path: path.name)
def test_what_is_called_exists(path: Path) -> None:
    text = without_comments(path)
    targets = set(re.findall(r"^([a-z-]+):", without_comments(ROOT / "Makefile"), re.MULTILINE))
    wanted = re.findall(r"(?:^|run:|&&|;)\s*make ([a-z-]+)", text, re.MULTILINE)
    assert not set(wanted) - targets
    for name in re.findall(r"(?<![\w/.-])((?:scripts|\.ci|tools)/[\w./-]*\w)", text):
        assert (ROOT / name).exists(), name
        assert name.startswith("tools/") or os.access(ROOT / name, os.X_OK), f"{name} cannot be run"


def test_each_workflow_calls_something_of_the_repository() -> None:
    for path in WORKFLOWS:
        runs = re.findall(r"^\s*- run: (.*)$", path.read_text(), re.MULTILINE)
        assert runs, path.name
        assert all(re.fullmatch(r"make [a-z-]+|\.ci/run", run) for run in runs), path.name


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


def test_hosted_ci_tries_every_python_that_the_package_names() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = {name for line in project["classifiers"] for name in re.findall(r"Python :: (3\.\d+)$", line)}
    for name in ("test.yml", "wheels.yml"):
        assert set(re.findall(r'"(3\.\d+)"', (ROOT / ".github" / "workflows" / name).read_text())) == named, name


def test_pre_commit_fetches_nothing() -> None:
    repositories = parsed(ROOT / ".pre-commit-config.yaml")["repos"]
    assert [repository["repo"] for repository in repositories] == ["local"]
    assert {hook["language"] for hook in repositories[0]["hooks"]} == {"system"}


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
