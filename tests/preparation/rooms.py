# SPDX-License-Identifier: Apache-2.0
"""The room of ``planes`` as a folder of videos with a calibration file."""

import json
from pathlib import Path

from captures import write_video
from planes import HEIGHT, WIDTH, room_frame, room_rig
from structgstream.cameras import CameraRig


def write_room(folder: Path, *, cameras: int = 5, frames: int = 2) -> CameraRig:
    """``cameras.json`` and a video a camera, all frames of one moment."""
    rig = room_rig(cameras)
    frame = room_frame(rig)
    for name in rig:
        write_video(folder / f"{name}.mp4", [frame.images[name]] * frames)
    entries = {
        name: {"K": camera.K.tolist(), "viewmat": camera.viewmat.tolist()} for name, camera in rig.cameras.items()
    }
    content = {"width": WIDTH, "height": HEIGHT, "fps": 30, "frames": frames, "held_out": [], "cameras": entries}
    (folder / "cameras.json").write_text(json.dumps(content))
    return rig
