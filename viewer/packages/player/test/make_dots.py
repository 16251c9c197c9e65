# SPDX-License-Identifier: Apache-2.0
"""Makes ``fixtures/dots.sgs``: three free Gaussians at known places before an environment of one colour, for tests of
headsets. Its unit is the metre, and z is up.

``python viewer/packages/player/test/make_dots.py``
"""

from pathlib import Path

import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig, Similarity
from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.codec.scene_coder import SceneEncoder
from structgstream.codec.sinks import MemorySink
from structgstream.scene.scene import Scene
from structgstream.scene.state import PAPER_DYNAMIC, FieldName, scene_of, state_of

STREAM = Path(__file__).parent / "fixtures" / "dots.sgs"
FPS, FRAMES = 5.0, 10
# A red, a green and a blue one: 1.5, 0.9 and 2 m above the floor.
DOTS = ((0.0, 0.0, 1.5), (0.6, 0.3, 0.9), (-0.7, 1.0, 2.0))
LENS_HEIGHT, DISTANCE = 1.2, 3.0
CENTER, SCALE = (0.5, -1.0, 1.0), 0.4
DEVIATION = 0.02  # metres
FLOOR = ((0.5, 0.5, 0.0), (0.5, -0.5, 0.0), (-0.5, 0.5, 0.0), (-0.5, -0.5, 0.0))
ANCHORS, OFFSETS, FEATURES, HIDDEN = len(FLOOR), 2, 4, 4


DYNAMIC = PAPER_DYNAMIC - {"anchor_positions"}


def camera(angle: float) -> Camera:
    """Upright, on a circle around the z axis, its optical axis level; at an angle of 0 it looks along y."""
    right = torch.tensor([torch.cos(torch.tensor(angle)), torch.sin(torch.tensor(angle)), 0.0], dtype=torch.float64)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    forward = torch.linalg.cross(right, down)
    eye = -DISTANCE * forward - LENS_HEIGHT * down
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.stack([right, down, forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    K = torch.tensor([[120.0, 0, 80], [0, 120.0, 60], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat, K, 160, 120, near=0.2)


def in_scene(points: Tensor) -> Tensor:
    return (points - torch.tensor(CENTER)) * SCALE


def scene() -> Scene:
    """The dots, and anchors on the floor whose Gaussians are all transparent."""

    def head(outputs: int, bias: float) -> Tensor:
        weights = torch.zeros(HIDDEN * (FEATURES + 4) + outputs * OFFSETS * (HIDDEN + 1))
        weights[-outputs * OFFSETS :] = bias
        return weights

    free = torch.zeros(len(DOTS), 14)
    free[:, :3] = in_scene(torch.tensor(DOTS))
    free[:, 3:6] = torch.log(torch.tensor(DEVIATION * SCALE))
    free[:, 6] = 1.0
    free[:, 10] = 6.0
    free[:, 11:14] = torch.eye(3)
    state: dict[FieldName, Tensor] = {
        "anchor_positions": in_scene(torch.tensor(FLOOR)),
        "offset_scales": torch.full((ANCHORS, 3), -3.0),
        "base_scales": torch.full((ANCHORS, 3), -3.0),
        "anchor_offsets": torch.zeros(ANCHORS, OFFSETS, 3),
        "anchor_features": torch.zeros(ANCHORS, FEATURES),
        "opacity_mlp": head(1, -1.0),
        "color_mlp": head(3, 0.0),
        "covariance_mlp": head(7, 1.0),
        "free": free,
        "free_births": torch.arange(len(DOTS)),
        "environment": torch.tensor([[-1.0, -1.0, 0.0]]),
        "camera_color": torch.tensor([[1.0, 1, 1, 0, 0, 0]]).repeat(3, 1),
    }
    return scene_of(state, distance_input=False)


def main() -> None:
    """Writes the stream."""
    made = scene()
    state = state_of(made)
    header = StreamHeader(
        rig=CameraRig({name: camera(angle) for name, angle in (("left", -0.4), ("middle", 0.0), ("right", 0.4))}),
        similarity=Similarity(CENTER, SCALE),
        fps=FPS,
        codec="raw",
        dynamic=DYNAMIC,
        static={name: value for name, value in state.items() if name not in DYNAMIC},
        distance_input=False,
        config={},
        metadata={"capture": "dots"},
    )
    encoder, sink = SceneEncoder(header), MemorySink()
    sink.open(header)
    for index in range(FRAMES):
        kind = PacketKind.DELTA if index else PacketKind.KEY
        sink.write(encoder.encode(made, index=index, pts_seconds=index / FPS, kind=kind).packet)
    sink.close()
    STREAM.write_bytes(sink.data)


if __name__ == "__main__":
    main()
