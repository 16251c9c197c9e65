# SPDX-License-Identifier: Apache-2.0
"""The built player: one JavaScript module, made from ``viewer/packages`` by ``scripts/build-player``.

It is part of the repository and the wheel, so that installing the package does not need Node. A test rebuilds and
compares it.
"""

from importlib.resources import files
from pathlib import Path

from structgstream.errors import PlayerError


def bundle_path() -> Path:
    """The file ``player.js``.

    Raises:
        PlayerError: the installation lacks it.
    """
    path = Path(str(files("structgstream.player") / "assets" / "player.js"))
    if not path.is_file():
        raise PlayerError(
            "The player is missing from the installation; reinstall structgstream, or, in a clone, run "
            "scripts/build-player."
        )
    return path


def bundle() -> str:
    """The module's source.

    Raises:
        PlayerError: the installation lacks it.
    """
    return bundle_path().read_text(encoding="utf-8")
