# SPDX-License-Identifier: Apache-2.0
"""Whether the tests find mistakes: each of ``mutants.toml`` is made in a copy of the sources and its tests are run.

``python -m lab.robustness.mutants`` from the repository's folder, with the names of some or without for all; the status
is 1 if one was not found, 2 if a test fails without any. The native library must be built in place.
"""

import argparse
import os
import shutil
import sys
import tempfile
import time
import tomllib
from pathlib import Path

import av  # noqa: F401  (loaded once for all, as the next two)
import cv2  # noqa: F401
import pytest
import torch  # noqa: F401

ROOT = Path(__file__).parents[3]
MUTANTS = Path(__file__).with_name("mutants.toml")


def is_found(mutant: dict, sources: Path) -> bool:
    """Whether tests fail with this mistake in the package in ``sources``, which is left as it was.

    Raises:
        ValueError: the place of the mistake is not there exactly once.
        RuntimeError: the tests could not be run.
    """
    file = sources / "structgstream" / mutant["file"]
    original = file.read_text()
    if original.count(mutant["before"]) != 1:
        raise ValueError(f"{mutant['file']} has {mutant['before']!r} {original.count(mutant['before'])} times")
    file.write_text(original.replace(mutant["before"], mutant["after"]))
    try:
        status = _run(sources, mutant["tests"])
    finally:
        file.write_text(original)
    if status not in (0, 1):
        raise RuntimeError(f"pytest ended with status {status}: {mutant['tests']}")
    return status == 1


def _run(sources: Path, tests: list[str]) -> int:
    """Status of pytest in a process of its own, in which the package is that of ``sources``."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    os.environ |= {"PYTHONPATH": str(sources), "PYTHONDONTWRITEBYTECODE": "1"}
    sys.dont_write_bytecode = True
    sys.path[:0] = [str(sources)]
    os.chdir(ROOT)
    with open(os.devnull, "w") as nothing:
        os.dup2(nothing.fileno(), 1)
        os._exit(int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *tests])))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    mutants = tomllib.loads(MUTANTS.read_text())
    names, missed = parser.parse_args().names or list(mutants), 0
    with tempfile.TemporaryDirectory() as folder:
        sources = Path(folder, "src")
        shutil.copytree(ROOT / "src", sources, ignore=shutil.ignore_patterns("__pycache__"))
        tests = sorted({test for name in names for test in mutants[name]["tests"]})
        if status := _run(sources, tests):
            print(f"pytest ended with status {status} without any mistake; mend that first", file=sys.stderr)
            return 2
        for name in names:
            start = time.monotonic()
            found = is_found(mutants[name], sources)
            missed += not found
            print(f"{name}: {'found' if found else 'NOT FOUND'} in {time.monotonic() - start:.0f} s", flush=True)
    print(f"{len(names) - missed} of {len(names)} found")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
