# SPDX-License-Identifier: Apache-2.0
"""Exports, licences, and what an import may pull in. Layers and docstrings are checked by ``scripts/check``."""

import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import structgstream

ROOT = Path(__file__).parents[2]
SOURCES = sorted((ROOT / "src").rglob("*.py"))


def test_public_names_are_sorted_and_importable() -> None:
    constants = [name for name in structgstream.__all__ if name.isupper()]
    others = [name for name in structgstream.__all__ if not name.isupper()]
    assert list(structgstream.__all__) == sorted(constants) + sorted(others)
    for name in structgstream.__all__:
        assert hasattr(structgstream, name), name


def test_every_source_states_its_licence() -> None:
    texts = {path: path.read_text() for path in SOURCES}
    assert not [path.name for path, text in texts.items() if text and "SPDX-License-Identifier: Apache-2.0" not in text]


def loaded_by(imports: str, among: tuple[str, ...]) -> list[str]:
    """Which of the modules ``among`` are there after ``imports`` in a process of its own."""
    code = f"import sys, {imports}; print(*(name for name in {among!r} if name in sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return result.stdout.split()


def test_importing_the_package_is_light() -> None:
    heavy = ("torch", "numpy", "av", "cv2", "matplotlib", "tyro", "rich")
    assert not loaded_by("structgstream, structgstream.cli", heavy)


def test_the_player_path_needs_no_optional_package() -> None:
    path = "structgstream.codec.reader, structgstream.scene.render, structgstream.kernels.backend"
    assert not loaded_by(path, ("av", "cv2", "scipy", "matplotlib", "tyro", "rich"))


def test_every_module_imports() -> None:
    for module in pkgutil.walk_packages(structgstream.__path__, "structgstream."):
        if not module.name.endswith(".__main__"):
            importlib.import_module(module.name)
