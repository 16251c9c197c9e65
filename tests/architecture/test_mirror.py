# SPDX-License-Identifier: Apache-2.0
"""Tests mirror the package: a module ``a/b.py`` has ``tests/a/test_b.py``.

What has none, because something larger is tested in its place, stands here with the file that does so.
"""

import ast
from fnmatch import fnmatch
from pathlib import Path

ROOT = Path(__file__).parents[2]
SOURCES, TESTS = ROOT / "src" / "structgstream", ROOT / "tests"

ELSEWHERE = {
    # Each converter is held to OpenCV's projection, and to files that their tools published.
    "data/calibration_files/*.py": "data/calibration_files/test_axes_units_pixels.py",
    # A kernel's wrapper is compared with the oracle of its operation, forward and gradient.
    "kernels/cpu_*.py": "parity/test_*.py",
    "kernels/cuda*.py": "parity/test_cuda_*.py",
    "kernels/ssim_arguments.py": "parity/test_ssim.py",
    "kernels/_load.py": "kernels/test_operations.py",
    "kernels/_nvcc.py": "kernels/test_cuda_nvcc.py",
    # These names are taken by tests of other modules on the path of helpers.
    "data/live/calibration.py": "data/live/test_live_calibration.py",
    "data/live/source.py": "data/live/test_live_source.py",
    "data/live/recording.py": "data/live/test_live_source.py",
    "data/source.py": "data/test_wrappers.py",
    "exporters/frames.py": "cli/test_export.py",
    "preparation/report/page.py": "preparation/report/test_write.py",
    "training/result.py": "training/test_optimize.py",
}
"""Patterns of modules without a test file of their name, and of the files that test them."""


def has_logic(path: Path) -> bool:
    """Whether a module does anything: a function with a body, and not constants, types and values alone."""
    functions = (ast.FunctionDef, ast.AsyncFunctionDef)
    return any(isinstance(node, functions) for node in ast.walk(ast.parse(path.read_text())))


def without_test() -> list[str]:
    """Modules with logic that have no test file of their name."""
    found = []
    for path in sorted(SOURCES.rglob("*.py")):
        place = path.relative_to(SOURCES)
        named = TESTS / place.parent / f"test_{place.name}"
        if path.name not in ("__init__.py", "__main__.py") and not named.is_file() and has_logic(path):
            found.append(place.as_posix())
    return found


def test_every_module_has_its_tests() -> None:
    assert not [name for name in without_test() if not any(fnmatch(name, pattern) for pattern in ELSEWHERE)]


def test_what_is_tested_elsewhere_is() -> None:
    """The table has no rows that nothing needs, and the files that it names are there."""
    lacking = without_test()
    assert not [pattern for pattern in ELSEWHERE if not any(fnmatch(name, pattern) for name in lacking)]
    assert not [files for files in ELSEWHERE.values() if not list(TESTS.glob(files))]
