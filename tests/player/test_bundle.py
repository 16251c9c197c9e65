# SPDX-License-Identifier: Apache-2.0
"""The player that comes with the package: what its sources give, and small."""

import gzip
import subprocess
from pathlib import Path

import pytest

from structgstream.errors import PlayerError
from structgstream.player import bundle as module
from structgstream.player.bundle import bundle, bundle_path

ROOT = Path(__file__).parents[2]
NO_NODE = 3
MOST_COMPRESSED_BYTES = 72_000


def test_it_is_what_its_sources_give() -> None:
    """Builds it again, where there is Node, and compares the bytes."""
    result = subprocess.run([ROOT / "scripts" / "build-player", "--check"], capture_output=True, text=True, check=False)
    if result.returncode == NO_NODE:
        pytest.skip(f"the player cannot be built here: {result.stdout.strip()}")
    assert result.returncode == 0, result.stdout + result.stderr
    packaged = ROOT / "src" / "structgstream" / "player" / "assets" / "player.js"
    assert bundle_path().read_bytes() == packaged.read_bytes()


def test_it_is_small() -> None:
    assert len(gzip.compress(bundle().encode(), 9)) <= MOST_COMPRESSED_BYTES


def test_it_states_its_licence_and_asks_nobody_for_anything() -> None:
    source = bundle()
    assert source.startswith("// SPDX-License-Identifier: Apache-2.0")
    addresses = {word for word in source.replace('"', " ").replace("`", " ").replace("'", " ").split() if "://" in word}
    assert all("www.w3.org" in address for address in addresses), addresses  # names of XML, never fetched


def test_an_installation_without_it_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "files", lambda _: tmp_path)
    with pytest.raises(PlayerError, match="reinstall structgstream"):
        bundle()
