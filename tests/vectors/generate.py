# SPDX-License-Identifier: Apache-2.0
"""Makes the golden streams of format version 2: one of each codec, one of two periods and one with sound, and what a
decoder must find.

With ``raw`` every number is a small multiple of a power of two; with ``compact`` it is the product of a whole number
and a float32, which need not be one: exact in JSON and on any machine. Run from the repository's root, only when a new
version or codec gets vectors of its own; files that are there stay: ``python tests/vectors/generate.py``.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig, Similarity
from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.codec.reader import StreamReader, open_stream
from structgstream.codec.scene_coder import SceneEncoder
from structgstream.codec.segments.sink import Clocks, SegmentsSink
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.sinks import MemorySink
from structgstream.codec.sound import FrameSound, SoundFormat, frame_sound
from structgstream.data.sound import SoundEncoder
from structgstream.opus import SAMPLE_RATE
from structgstream.scene.scene import Scene
from structgstream.scene.state import PAPER_DYNAMIC, FieldName, scene_of, state_of

FOLDER = Path(__file__).parent
STREAM, EXPECTED, SUMS = (FOLDER / name for name in ("version-2.sgs", "version-2.json", "SHA256SUMS"))
COMPACT_STREAM, COMPACT_EXPECTED = (FOLDER / f"version-2-compact.{suffix}" for suffix in ("sgs", "json"))
PERIODS_STREAM, PERIODS_EXPECTED = (FOLDER / f"version-2-periods.{suffix}" for suffix in ("sgs", "json"))
SOUND_STREAM, SOUND_EXPECTED = (FOLDER / f"version-2-sound.{suffix}" for suffix in ("sgs", "json"))
SEGMENTS = FOLDER / "segments-1"
ANCHORS, K, FEATURES, HIDDEN = 3, 2, 2, 3
KINDS = (PacketKind.KEY, PacketKind.DELTA, PacketKind.KEY)
COMPACT_KINDS = (PacketKind.KEY, PacketKind.DELTA, PacketKind.DELTA, PacketKind.KEY, PacketKind.DELTA, PacketKind.DELTA)
COMPACT_ANCHORS = 21
PERIODS_KINDS = (PacketKind.KEY, PacketKind.DELTA, PacketKind.DELTA, PacketKind.KEY) * 2
LATER = 4
"""The first frame of the second period."""
COMPACT_BIRTHS = (
    (0, 1, 5),
    (0, 1, 5, 2**32, 2**32 + 1),
    (1, 2**32 + 1),
    (1, 2**32 + 1, 3 * 2**32, 3 * 2**32 + 2, 3 * 2**32 + 2**31 - 1),
    (),
    (5 * 2**32 + 7,),
)
COMPACT_STEPS = {
    "anchor_positions": 1 / 256,
    "offset_scales": float(np.float32(0.02)),
    "covariance_mlp": float(np.float32(0.003)),
    "free_means": 1 / 128,
    "free_log_scales": float(np.float32(0.05)),
    "free_quats": 1 / 64,
    "free_logit_opacities": 1 / 8,
    "free_colors": float(np.float32(0.007)),
}
COMPACT_INIT_STEPS: dict[FieldName, float] = {
    "anchor_positions": COMPACT_STEPS["anchor_positions"],
    "offset_scales": COMPACT_STEPS["offset_scales"],
    "base_scales": float(np.float32(0.01)),
    "anchor_offsets": 1 / 16,
    "anchor_features": float(np.float32(0.03)),
    "opacity_mlp": 1 / 32,
    "color_mlp": 1 / 16,
    "covariance_mlp": float(np.float32(0.003)),
    "appearance": 1 / 8,
    "appearance_basis": float(np.float32(0.001)),
    "environment": float(np.float32(0.004)),
}
COLUMNS = {"free_means": 3, "free_log_scales": 3, "free_quats": 4, "free_logit_opacities": 1, "free_colors": 3}


def numbers(*shape: int, salt: int) -> Tensor:
    """Sixteenths between -4 and 4 that look arbitrary."""
    count = int(torch.tensor(shape).prod())
    return ((torch.arange(count) * 37 + salt * 53) % 129 - 64).float().reshape(shape) / 16


def mlp_size(outputs: int) -> int:
    """Weights of an MLP with ``outputs`` numbers for each Gaussian."""
    return HIDDEN * (FEATURES + 5) + outputs * K * (HIDDEN + 1)


def golden_scene(frame: int) -> Scene:
    """Frame 0 has no free Gaussians, frame 1 two, frame 2 one of them and a new one."""
    births = torch.tensor([[], [5, 2**40], [5, 2**40 + 1]][frame], dtype=torch.int64)
    state: dict[FieldName, Tensor] = {
        "anchor_positions": numbers(ANCHORS, 3, salt=1 + 100 * frame),
        "offset_scales": numbers(ANCHORS, 3, salt=2 + 100 * frame),
        "base_scales": numbers(ANCHORS, 3, salt=3),
        "anchor_offsets": numbers(ANCHORS, K, 3, salt=4),
        "anchor_features": numbers(ANCHORS, FEATURES, salt=5),
        "opacity_mlp": numbers(mlp_size(1), salt=6),
        "color_mlp": numbers(mlp_size(3), salt=7),
        "covariance_mlp": numbers(mlp_size(7), salt=8 + 100 * frame),
        "free": numbers(len(births), 14, salt=9 + 100 * frame),
        "free_births": births,
        "camera_color": numbers(2, 6, salt=11),
    }
    return scene_of(state, distance_input=True)


def golden_header() -> StreamHeader:
    """Three cameras on a line, the middle one held out."""
    cameras = {}
    for i, name in enumerate(("left", "middle", "right")):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[0, 3], viewmat[2, 3] = 1.0 - i, 4.5
        K_matrix = torch.tensor([[40.0, 0, 24], [0, 40.25, 16], [0, 0, 1]], dtype=torch.float64)
        cameras[name] = Camera(viewmat, K_matrix, 48, 32, near=0.125)
    return StreamHeader(
        rig=CameraRig(cameras, frozenset({"middle"})),
        similarity=Similarity((0.25, -0.5, 3.0), 0.75),
        fps=30.0,
        codec="raw",
        dynamic=PAPER_DYNAMIC,
        static={name: value for name, value in state_of(golden_scene(0)).items() if name not in PAPER_DYNAMIC},
        distance_input=True,
        config={"seed": 7, "online": {"iterations": 10}},
        metadata={"capture": "golden", "note": "ä"},
    )


def compact_scene(frame: int) -> Scene:
    """Anchors 3 to 8 wander, 14 jumps in frame 4, weights of F_Sigma change in frames 1 and 4; free ones come and go.

    Anchors are in no order, 20 is far from all others, and rows of what stays are multiples of powers of two. Every
    number is exactly that of a bin, so this is also what a decoder must find.
    """
    moves = torch.zeros(COMPACT_ANCHORS, 6, dtype=torch.int64)
    for past in range(1, frame + 1):
        moves[3 + past % 2 : 9] += whole(6 - past % 2, 6, salt=past, most=3)
    if frame >= 4:
        moves[14] += torch.tensor([900, -900, 9, -8, 0, 70_000])
    weights = whole(mlp_size(7), salt=8, most=400)
    weights[::5] += (frame >= 1) + 12 * (frame >= 4)
    births = torch.tensor(COMPACT_BIRTHS[frame], dtype=torch.int64)
    # Of each birth, in each frame: the first two columns of its mean move in odd frames.
    free = torch.cat([whole(0, 14, salt=0, most=1), *(whole(1, 14, salt=int(b % 1000), most=90) for b in births)])
    free[:, :2] += frame // 2 * whole(len(births), 2, salt=3, most=4)
    steps = COMPACT_STEPS
    rows = whole(COMPACT_ANCHORS, 6, salt=1, most=300) + moves
    rows[20, :3] += torch.tensor([600_000, -9, 400_000])
    init_steps, powers = COMPACT_INIT_STEPS, 2 ** (torch.arange(COMPACT_ANCHORS)[:, None] % 5)
    features = whole(COMPACT_ANCHORS, FEATURES, salt=5, most=4) * powers
    columns = free.split([*COLUMNS.values()], dim=1)
    state: dict[FieldName, Tensor] = {
        "anchor_positions": dequantize(rows[:, :3], steps["anchor_positions"]),
        "offset_scales": dequantize(rows[:, 3:], steps["offset_scales"]),
        "base_scales": dequantize(whole(COMPACT_ANCHORS, 3, salt=3, most=9) * powers - 400, init_steps["base_scales"]),
        "anchor_offsets": numbers(COMPACT_ANCHORS, K, 3, salt=4),
        "anchor_features": dequantize(features, init_steps["anchor_features"]),
        "opacity_mlp": numbers(mlp_size(1), salt=6),
        "color_mlp": numbers(mlp_size(3), salt=7),
        "covariance_mlp": dequantize(weights, steps["covariance_mlp"]),
        "free": torch.cat([dequantize(part, steps[name]) for part, name in zip(columns, COLUMNS, strict=True)], dim=1),
        "free_births": births,
        "camera_color": numbers(2, 6, salt=11),
        "appearance": dequantize(whole(COMPACT_ANCHORS, 3, salt=12, most=1) * powers, init_steps["appearance"]),
        "appearance_basis": dequantize(whole(3, FEATURES, salt=13, most=300), init_steps["appearance_basis"]),
        "environment": dequantize(whole(4, 3, salt=14, most=250), init_steps["environment"]),
    }
    return scene_of(state, distance_input=True)


def whole(*shape: int, salt: int, most: int) -> Tensor:
    """Whole numbers from ``-most`` to ``most`` that look arbitrary."""
    count = int(torch.tensor(shape).prod())
    return ((torch.arange(count) * 7919 + salt * 104_729) % (2 * most + 1) - most).reshape(shape)


def dequantize(bins: Tensor, step: float) -> Tensor:
    """What bins stand for: the product of two float32."""
    return torch.from_numpy(bins.numpy().astype(np.float32) * np.float32(step))


def compact_header() -> StreamHeader:
    """As :func:`golden_header`, with frame 0 as the reference."""
    state = state_of(compact_scene(0))
    return replace(
        golden_header(),
        codec="compact",
        static={name: value for name, value in state.items() if name not in PAPER_DYNAMIC},
        steps=COMPACT_STEPS,
        reference={name: state[name] for name in ("anchor_positions", "offset_scales", "covariance_mlp")},
        init_steps=COMPACT_INIT_STEPS,
    )


def later_scene(frame: int) -> Scene:
    """Of the second period: the scenes of the first with fewer anchors, a still F_Sigma, no environment, own births."""
    state = state_of(compact_scene(frame - LATER))
    rows = ("anchor_positions", "offset_scales", "base_scales", "anchor_offsets", "anchor_features", "appearance")
    state |= {name: state[name][9:] for name in rows}
    state["covariance_mlp"] = state_of(compact_scene(0))["covariance_mlp"]
    state["free_births"] = state["free_births"] + LATER * 2**32
    del state["environment"]
    return scene_of(state, distance_input=True)


def later_header() -> StreamHeader:
    """That of the second period, in which F_Sigma is not dynamic."""
    state, dynamic = state_of(later_scene(LATER)), PAPER_DYNAMIC - {"covariance_mlp"}
    return replace(
        compact_header(),
        dynamic=dynamic,
        static={name: value for name, value in state.items() if name not in dynamic},
        steps={name: step for name, step in COMPACT_STEPS.items() if name != "covariance_mlp"},
        reference={name: state[name] for name in ("anchor_positions", "offset_scales")},
        init_steps={name: step for name, step in COMPACT_INIT_STEPS.items() if name != "environment"},
        metadata={"capture": "golden", "note": "later"},
        periods=True,
    )


def periods_scenes() -> list[Scene]:
    """Of both periods."""
    return [compact_scene(i) if i < LATER else later_scene(i) for i in range(len(PERIODS_KINDS))]


def periods_stream() -> bytes:
    """That of two periods."""
    header = replace(compact_header(), periods=True)
    return streamed(header, periods_scenes(), PERIODS_KINDS, later={LATER: later_header()})


def streamed(
    header: StreamHeader,
    scenes: Sequence[Scene],
    kinds: Sequence[PacketKind],
    *,
    fps: int = 4,
    later: Mapping[int, StreamHeader] | None = None,
    sounds: Sequence[FrameSound] = (),
) -> bytes:
    """The whole stream as today's encoder writes it, with headers of ``later`` periods by their first frame."""
    encoder, sink = SceneEncoder(header), MemorySink()
    sink.open(header)
    for index, (scene, kind) in enumerate(zip(scenes, kinds, strict=True)):
        if later and index in later:
            sink.begin(later[index])
            encoder = SceneEncoder(later[index])
        packet = encoder.encode(scene, index=index, pts_seconds=index / fps, kind=kind).packet
        sink.write(replace(packet, sound=sounds[index].pack()) if sounds else packet)
    sink.close()
    return sink.data


def plain_fields(scene: Scene) -> dict[str, Any]:
    """A scene as plain values: tensors as shape and flat list, in the order of the state table."""
    return {
        name: {"shape": list(value.shape), "values": value.flatten().tolist()}
        for name, value in state_of(scene).items()
    }


def reported(scenes: Sequence[Scene], kinds: Sequence[PacketKind]) -> dict[str, Any]:
    """What is in a stream, as plain values."""
    return {
        "frames": [
            {"index": index, "pts_seconds": index / 4, "kind": kind.name, "fields": plain_fields(scene)}
            for index, (scene, kind) in enumerate(zip(scenes, kinds, strict=True))
        ]
    }


def golden_stream() -> bytes:
    """That of codec ``raw``."""
    return streamed(golden_header(), [golden_scene(i) for i in range(len(KINDS))], KINDS)


def compact_stream() -> bytes:
    """That of codec ``compact``."""
    return streamed(compact_header(), [compact_scene(i) for i in range(len(COMPACT_KINDS))], COMPACT_KINDS)


CLAP_SECONDS, SOUND_FRAMES, SOUND_FPS = 0.5, 12, 12
"""A second with a clap in its middle: the frame of that time is white, the others are black."""
SOUND_KINDS = (PacketKind.KEY, PacketKind.DELTA, PacketKind.DELTA, PacketKind.DELTA) * 3


def clapping_scene(frame: int) -> Scene:
    """One free Gaussian that fills the pictures, and no anchor."""
    seen = [1.0] * 3 if frame == round(CLAP_SECONDS * SOUND_FPS) else [0.0] * 3
    state: dict[FieldName, Tensor] = {
        "anchor_positions": torch.zeros(0, 3),
        "offset_scales": torch.zeros(0, 3),
        "base_scales": torch.zeros(0, 3),
        "anchor_offsets": torch.zeros(0, K, 3),
        "anchor_features": torch.zeros(0, FEATURES),
        "opacity_mlp": numbers(mlp_size(1), salt=6),
        "color_mlp": numbers(mlp_size(3), salt=7),
        "covariance_mlp": numbers(mlp_size(7), salt=8),
        "free": torch.tensor([[-0.1875, 0.375, -2.25, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 8.0, *seen]]),
        "free_births": torch.tensor([0]),
        "camera_color": torch.zeros(2, 6),
    }
    return scene_of(state, distance_input=True)


def clapping_sounds() -> list[FrameSound]:
    """The sound of each frame, as the encoder of the day makes it."""
    import av

    samples = np.zeros((1, SAMPLE_RATE), np.float32)
    burst = np.random.default_rng(0).uniform(-0.9, 0.9, 480) * np.exp(-np.arange(480) / 96)
    first = round(CLAP_SECONDS * SAMPLE_RATE)
    samples[0, first : first + len(burst)] = burst
    frame = av.AudioFrame.from_ndarray(samples, format="flt", layout="mono")
    frame.sample_rate = SAMPLE_RATE
    encoder = SoundEncoder(1)
    packets = [*encoder.add(frame, 0.0), *encoder.finish()]
    sounds = []
    for index in range(SOUND_FRAMES):
        end = (index + 1) / SOUND_FPS
        heard = [packet for packet in packets if end - 1 / SOUND_FPS <= max(packet.seconds, 0.0) < end]
        sounds.append(frame_sound(index, index / SOUND_FPS, heard))
    return sounds


def sound_stream() -> bytes:
    """That with sound: of codec ``raw``, in which only free Gaussians are dynamic."""
    dynamic: frozenset[FieldName] = frozenset({"free", "free_births"})
    state = state_of(clapping_scene(0))
    header = replace(
        golden_header(),
        fps=float(SOUND_FPS),
        dynamic=dynamic,
        static={name: value for name, value in state.items() if name not in dynamic},
        sound=SoundFormat(1),
    )
    scenes = [clapping_scene(index) for index in range(SOUND_FRAMES)]
    return streamed(header, scenes, SOUND_KINDS, fps=SOUND_FPS, sounds=clapping_sounds())


def sound_report(data: bytes) -> dict[str, Any]:
    """What is in the stream with sound; the packets of Opus are those that it was written with."""
    report = reported([clapping_scene(index) for index in range(SOUND_FRAMES)], SOUND_KINDS)
    with StreamReader(data) as reader:
        for frame in report["frames"]:
            sound = reader.sound(frame["index"])
            assert sound is not None, "written with each frame"
            frame["pts_seconds"] = frame["index"] / SOUND_FPS
            frame["sound"] = {"seconds": sound.seconds, "packets": [packet.hex() for packet in sound.packets]}
    return {"sound": {"codec": "opus", "channels": 1}, **report}


def write_segments(folder: Path) -> None:
    """The stream of codec ``compact`` while it is made: a segment of the first group, parts of the second."""
    store = FolderStore(folder)
    store.prepare()
    reader = open_stream(COMPACT_STREAM)
    seconds = iter(range(100))
    sink = SegmentsSink(store, clocks=Clocks(wall=lambda: 1.7e9 + next(seconds), captured=lambda frame: 1.6e9 + frame))
    sink.open(reader.header)
    for index in range(len(reader)):
        (*_, packet) = reader.group(index)
        sink.write(packet)
    for name in store.names():
        if name.startswith("part-") and int(name.split("-")[1]) < 3:
            store.delete(name)


def main() -> None:
    """Write what is missing, and the sums of all."""
    raw, compact = [golden_scene(i) for i in range(3)], [compact_scene(i) for i in range(6)]
    sound = SOUND_STREAM.read_bytes() if SOUND_STREAM.exists() else sound_stream()
    files = {
        STREAM: golden_stream(),
        EXPECTED: (json.dumps(reported(raw, KINDS)) + "\n").encode(),
        COMPACT_STREAM: compact_stream(),
        COMPACT_EXPECTED: (json.dumps(reported(compact, COMPACT_KINDS)) + "\n").encode(),
        PERIODS_STREAM: periods_stream(),
        PERIODS_EXPECTED: (json.dumps(reported(periods_scenes(), PERIODS_KINDS)) + "\n").encode(),
        SOUND_STREAM: sound,
        SOUND_EXPECTED: (json.dumps(sound_report(sound)) + "\n").encode(),
    }
    for path, data in files.items():
        if not path.exists():
            path.write_bytes(data)
    if not SEGMENTS.exists():
        write_segments(SEGMENTS)
    found = [*files, *sorted(SEGMENTS.iterdir())]
    sums = [(hashlib.sha256(path.read_bytes()).hexdigest(), path.relative_to(FOLDER)) for path in found]
    SUMS.write_text("".join(f"{digest}  {name}\n" for digest, name in sums))


if __name__ == "__main__":
    main()
