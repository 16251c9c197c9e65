# SPDX-License-Identifier: Apache-2.0
"""The room of ``planes`` as a folder of videos with a calibration file."""

import json
import shutil
from pathlib import Path

from structgstream.cameras import CameraRig
from tests.support.captures import write_video
from tests.support.planes import HEIGHT, WIDTH, room_frame, room_rig
from tests.support.shared_folder import made_once


def write_room(folder: Path, *, cameras: int = 5, frames: int = 2) -> CameraRig:
    """``cameras.json`` and a video a camera, all frames of one moment."""
    made = made_once(f"room-{cameras}-{frames}", lambda path: _film_room(path, room_rig(cameras), frames))
    shutil.copytree(made, folder, copy_function=shutil.copyfile, dirs_exist_ok=True)
    return room_rig(cameras)


def _film_room(folder: Path, rig: CameraRig, frames: int) -> None:
    frame = room_frame(rig)
    for name in rig:
        write_video(folder / f"{name}.mp4", [frame.images[name]] * frames)
    entries = {
        name: {"K": camera.K.tolist(), "viewmat": camera.viewmat.tolist()} for name, camera in rig.cameras.items()
    }
    content = {"width": WIDTH, "height": HEIGHT, "fps": 30, "frames": frames, "held_out": [], "cameras": entries}
    (folder / "cameras.json").write_text(json.dumps(content))
