# SPDX-License-Identifier: Apache-2.0
"""What is asked of a wheel; `make wheel` asks it of a real one."""

import json
import runpy
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
VECTORS = ROOT / "tests" / "vectors"


@pytest.fixture(scope="module")
def contents() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "tools" / "wheel" / "contents.py"))


@pytest.fixture(scope="module")
def smoke() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "tools" / "wheel" / "smoke.py"))


def test_the_sources_hold_what_a_wheel_needs(contents: dict[str, Any]) -> None:
    made = {name for name in contents["NEEDED"] if "/_native/" in name}
    sources = contents["sources"]()
    assert set(contents["NEEDED"]) - made <= sources
    assert sum(name.startswith("structgstream/data/clip/cam") for name in sources) == 11
    for name in made - {"structgstream/_native/libstructgstream.so"}:
        assert (ROOT / "csrc" / "cuda" / Path(name).name).is_file()


def test_a_whole_wheel_is_accepted(contents: dict[str, Any]) -> None:
    described = {"structgstream-1.dist-info/METADATA", "structgstream.libs/libgomp.so.1"}
    names = contents["sources"]() | set(contents["NEEDED"]) | described
    assert contents["problems"](names, contents["sources"]()) == []


@pytest.mark.parametrize(
    "name", ["structgstream/py.typed", "structgstream/_native/cuda/ssim.cu", "structgstream/flow.py"]
)
def test_a_missing_file_is_reported(contents: dict[str, Any], name: str) -> None:
    wanted = contents["sources"]()
    names = (wanted | set(contents["NEEDED"])) - {name}
    assert contents["problems"](names, wanted) == [f"The wheel lacks {name}."]


def test_a_file_too_many_is_reported(contents: dict[str, Any]) -> None:
    wanted = contents["sources"]()
    names = wanted | set(contents["NEEDED"]) | {"tests/conftest.py"}
    assert contents["problems"](names, wanted) == [
        "The wheel holds tests/conftest.py, which is no file of the package."
    ]


def test_the_trial_reads_the_golden_stream(smoke: dict[str, Any], tmp_path: Path) -> None:
    stream, expected = VECTORS / "version-2-compact.sgs", VECTORS / "version-2-compact.json"
    assert smoke["check_decoder"](stream, expected) == 6
    wrong = json.loads(expected.read_text())
    wrong["frames"][3]["fields"]["anchor_positions"]["values"][0] += 1.0
    (tmp_path / "wrong.json").write_text(json.dumps(wrong))
    with pytest.raises(AssertionError, match="frame 3 is not the golden one"):
        smoke["check_decoder"](stream, tmp_path / "wrong.json")
