# SPDX-License-Identifier: Apache-2.0
"""Makes the small streams that browser tests draw, and their references.

``python viewer/packages/gl/test/make_fixtures.py CLIP_STREAM`` cuts a window with a moving ball out of a stream of the
bundled clip (``patch``), and makes a scene of random numbers whose MLPs take several passes and fill no texel
(``odd``). Then it runs ``make_references.py`` on both.
"""

import argparse
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig, Similarity
from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.codec.reader import open_stream
from structgstream.codec.scene_coder import SceneEncoder
from structgstream.codec.sinks import MemorySink
from structgstream.scene.scene import Scene
from structgstream.scene.state import PAPER_DYNAMIC, FieldName, scene_of, state_of

FOLDER = Path(__file__).parent / "fixtures"
FRAMES = (0, 3, 6, 9)
KINDS = (PacketKind.KEY, PacketKind.DELTA, PacketKind.DELTA, PacketKind.KEY)
WINDOW_PIXELS, WINDOW_CENTER = (56, 44), (62.0, 180.0)
CAMERAS = 5
ROWS: tuple[FieldName, ...] = (
    "anchor_positions", "offset_scales", "base_scales", "anchor_offsets", "anchor_features", "appearance"
)  # fmt: skip
ODD_ANCHORS, ODD_OFFSETS, ODD_FEATURES, ODD_HIDDEN, ODD_FREE = 90, 7, 6, 10, 12


def written(header: StreamHeader, scenes: list[Scene]) -> bytes:
    """A stream of ``scenes``."""
    encoder, sink = SceneEncoder(header), MemorySink()
    sink.open(header)
    for index, (scene, kind) in enumerate(zip(scenes, KINDS, strict=True)):
        sink.write(encoder.encode(scene, index=index, pts_seconds=index / header.fps, kind=kind).packet)
    sink.close()
    return sink.data


def cropped(camera: Camera, center: Tensor) -> Camera:
    """``camera`` with the window around the pixel of ``center`` (capture's units) as its picture."""
    pixel = camera.K @ (camera.viewmat[:3, :3] @ center + camera.viewmat[:3, 3])
    K = camera.K.clone()
    K[0, 2] += WINDOW_PIXELS[0] / 2 - pixel[0] / pixel[2]
    K[1, 2] += WINDOW_PIXELS[1] / 2 - pixel[1] / pixel[2]
    return replace(camera, K=K, width=WINDOW_PIXELS[0], height=WINDOW_PIXELS[1])


def inside(camera: Camera, points: Tensor) -> Tensor:
    """Mask ``[n]`` of the ``points`` ``[n, 3]`` (scene units) that ``camera`` sees in the window."""
    seen = points.double() @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = (seen / seen[:, 2:] @ camera.K.T)[:, :2]
    half = torch.tensor(WINDOW_PIXELS) / 2
    return ((pixels - torch.tensor(WINDOW_CENTER)).abs() < half).all(1) & (seen[:, 2] > camera.near)


def rows_of(fields: dict[FieldName, Tensor], rows: Tensor) -> dict[FieldName, Tensor]:
    """``fields`` with only these anchors."""
    return {name: value[rows].contiguous() if name in ROWS else value for name, value in fields.items()}


def patch(path: Path) -> bytes:
    """The anchors that a held-out camera sees in a window."""
    reader = open_stream(path)
    header = reader.header
    scenes = [reader.scene(frame) for frame in FRAMES]
    held_out = header.rig.testing[0]
    camera = header.similarity.camera(header.rig[held_out])
    anchors = torch.stack([inside(camera, scene.anchors.positions) for scene in scenes]).any(0)
    rows = anchors.nonzero()[:, 0]
    middle = header.similarity.inverse_points(scenes[0].anchors.positions[rows].double().median(0).values)
    names = [held_out, *header.rig.training[: CAMERAS - 1]]
    training = [header.rig.training.index(name) for name in names[1:]]
    small = replace(
        header,
        rig=CameraRig({name: cropped(header.rig[name], middle) for name in names}, frozenset({held_out})),
        static=rows_of(dict(header.static), rows) | {"camera_color": header.static["camera_color"][training]},
        reference=rows_of(dict(header.reference), rows),
    )
    births = torch.cat([scene.free.births[inside(camera, scene.free.means)] for scene in scenes])
    states: list[dict[FieldName, Tensor]] = []
    for scene in scenes:
        state = state_of(replace(scene, free=scene.free.select(torch.isin(scene.free.births, births))))
        state["camera_color"] = small.static["camera_color"]
        states.append(rows_of(state, rows))
    return written(small, [scene_of(state, distance_input=header.distance_input) for state in states])


def odd() -> bytes:
    """Random anchors and free Gaussians with codec ``raw``; nothing is a multiple of four."""
    g = torch.Generator().manual_seed(5)

    def numbers(*shape: int, size: float = 1.0, middle: float = 0.0) -> Tensor:
        return middle + size * torch.randn(*shape, generator=g)

    inputs = ODD_FEATURES + 3

    def head(outputs: int) -> Tensor:
        return numbers(ODD_HIDDEN * (inputs + 1) + outputs * ODD_OFFSETS * (ODD_HIDDEN + 1), size=0.5)

    free = numbers(ODD_FREE, 14)
    free[:, 3:6] -= 2.0
    # Large ones outside the picture and close to the cameras: there the projection's limits show.
    free[:4, :3] = torch.tensor([[2.4, 0.5, -0.9], [-2.4, 0.2, -0.8], [0.3, 1.9, -1.0], [0.2, -2.0, -0.7]])
    free[:4, 3:6] = torch.tensor([-0.8, -1.2, -0.5])
    free[:4, 10] = 1.0
    state: dict[FieldName, Tensor] = {
        "anchor_positions": numbers(ODD_ANCHORS, 3),
        "offset_scales": numbers(ODD_ANCHORS, 3, size=0.3, middle=-1.5),
        "base_scales": numbers(ODD_ANCHORS, 3, size=0.5, middle=-1.5),
        "anchor_offsets": numbers(ODD_ANCHORS, ODD_OFFSETS, 3),
        "anchor_features": numbers(ODD_ANCHORS, ODD_FEATURES),
        "opacity_mlp": head(1),
        "color_mlp": head(3),
        "covariance_mlp": head(7),
        "free": free,
        "free_births": torch.arange(ODD_FREE),
        "camera_color": torch.tensor([[0.8, 0.9, 1.1, 0.05, 0.0, -0.05], [1.2, 1.1, 0.9, -0.05, 0.0, 0.05]]),
    }
    cameras = {}
    for i, name in enumerate(("left", "middle", "right")):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[0, 3], viewmat[2, 3] = 1.0 - i, 4.5
        K = torch.tensor([[70.0, 0, 37], [0, 71.0, 25], [0, 0, 1]], dtype=torch.float64)
        cameras[name] = Camera(viewmat, K, 72, 52, near=0.125)
    header = StreamHeader(
        rig=CameraRig(cameras, frozenset({"middle"})),
        similarity=Similarity((0.25, -0.5, 0.5), 0.75),
        fps=30.0,
        codec="raw",
        dynamic=PAPER_DYNAMIC,
        static={name: value for name, value in state.items() if name not in PAPER_DYNAMIC},
        distance_input=False,
        config={"seed": 5},
        metadata={"capture": "odd"},
    )
    scenes = []
    for frame in range(len(KINDS)):
        # One free Gaussian more in each frame, and every dynamic field another one.
        moved: dict[FieldName, Tensor] = {
            "anchor_positions": state["anchor_positions"] + 0.1 * frame,
            "covariance_mlp": state["covariance_mlp"] * (1 - 0.05 * frame),
            "free": free[: ODD_FREE - 3 + frame],
            "free_births": state["free_births"][: ODD_FREE - 3 + frame],
        }
        scenes.append(scene_of({**state, **moved}, distance_input=False))
    return written(header, scenes)


def main() -> None:
    """Writes streams and references."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("clip", type=Path)
    clip: Path = parser.parse_args().clip
    for name, data in (("patch", patch(clip)), ("odd", odd())):
        FOLDER.mkdir(exist_ok=True)
        stream = FOLDER / f"{name}.sgs"
        stream.write_bytes(data)
        script = Path(__file__).with_name("make_references.py")
        arguments = [str(stream), str(FOLDER / name), "--frames", "3", "--arc", "3", "--outputs", "100"]
        subprocess.run([sys.executable, str(script), *arguments], check=True)


if __name__ == "__main__":
    main()
