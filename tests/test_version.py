# SPDX-License-Identifier: Apache-2.0
import tomllib
from pathlib import Path

from structgstream.version import __version__


def test_the_version_is_that_of_the_distribution() -> None:
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    assert __version__ == project["version"]
