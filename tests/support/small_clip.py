# SPDX-License-Identifier: Apache-2.0
"""The bundled clip with six of its ten cameras: fitting, flow and denoising take their time for each camera."""

import json
import shutil
from pathlib import Path

from structgstream.data.dataset_layouts import bundled_clip_path
from tests.support.shared_folder import made_once

CAMERAS = ("cam00", "cam01", "cam02", "cam03", "cam04", "cam05")
"""The held-out one, and five on an arc around it."""


def small_clip_path() -> Path:
    """A capture named ``clip``, in the layout of the bundled one."""
    return made_once("small-clip", _make) / "clip"


def _make(folder: Path) -> None:
    bundled = bundled_clip_path()
    (folder / "clip").mkdir()
    content = json.loads((bundled / "cameras.json").read_text())
    content["cameras"] = {name: content["cameras"][name] for name in CAMERAS}
    (folder / "clip" / "cameras.json").write_text(json.dumps(content))
    for name in CAMERAS:
        shutil.copy(bundled / f"{name}.mp4", folder / "clip")
