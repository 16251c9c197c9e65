# SPDX-License-Identifier: Apache-2.0
"""Says what a wheel of structgstream lacks, or has too much. Usage: python tools/wheel/contents.py WHEEL"""

import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
NEEDED = (
    "structgstream/py.typed",
    "structgstream/serve/assets/player.js",
    "structgstream/data/clip/cameras.json",
    "structgstream/_native/libstructgstream.so",
    *(f"structgstream/_native/cuda/{name}" for name in ("ssim.cu", "ssim.h", "ssim_calls.h", "ssim_phases.h")),
)
BESIDE = (".dist-info/", ".libs/")
"""Folders of a wheel that are no package: its description, and the libraries that were grafted."""


def sources() -> set[str]:
    """Every file of the package in the repository, as a wheel names it."""
    source = ROOT / "src"
    files = (path for path in (source / "structgstream").rglob("*") if path.is_file())
    return {path.relative_to(source).as_posix() for path in files if not {"__pycache__", "_native"} & set(path.parts)}


def problems(names: set[str], wanted: set[str]) -> list[str]:
    """What is wrong with a wheel of these files, a sentence each.

    Args:
        names: the files of the wheel.
        wanted: the files that the repository has for it.
    """
    found = [f"The wheel lacks {name}." for name in sorted((wanted | set(NEEDED)) - names)]
    extra = {name for name in names - wanted if not name.startswith("structgstream/_native/")}
    extra = {name for name in extra if not any(part in name for part in BESIDE)}
    return found + [f"The wheel holds {name}, which is no file of the package." for name in sorted(extra)]


def main(wheel: Path) -> None:
    """Reports on a wheel; fails when something is wrong with it."""
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
    found = problems(names, sources())
    if found:
        sys.exit("\n".join(found))
    grafted = [Path(name).name for name in sorted(names) if ".libs/" in name]
    print(
        f"{wheel.name}: {len(names)} files, {wheel.stat().st_size / 1e6:.1f} MB, grafted: {', '.join(grafted) or '-'}"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
