# SPDX-License-Identifier: Apache-2.0
"""Makes small streams of the compact codec, and the numbers that the Python decoder finds in them.

Run from the repository's root when the codec changes: ``python viewer/packages/core/test/make_fixtures.py``. With
``--bench ANCHORS PATH`` it writes one stream for ``bench/decode.mjs`` instead.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig, Similarity
from structgstream.codec.fields.packet_fields import CODABLE, FREE_PARAMETERS, dequantize_state, quantize_state
from structgstream.codec.fields.quantization import round_to_bins
from structgstream.codec.fields.static_fields import UNCODED_FIELDS
from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.codec.scene_coder import SceneEncoder
from structgstream.codec.sinks import MemorySink
from structgstream.scene.order import morton_order
from structgstream.scene.scene import Scene
from structgstream.scene.state import PAPER_DYNAMIC, FieldName, scene_of, state_of

FOLDER = Path(__file__).parent / "fixtures"
GROUP = 4
ROWS: tuple[FieldName, ...] = ("anchor_positions", "offset_scales", "base_scales")
WEIGHTS: tuple[FieldName, ...] = ("opacity_mlp", "color_mlp", "covariance_mlp")
STEPS = dict.fromkeys((*ROWS, *WEIGHTS, *(parameter.name for parameter in FREE_PARAMETERS)), 2.0 ** (-9)) | {
    "offset_scales": float(torch.tensor(0.01)),
    "appearance": 2.0**-5,
}


def first_state(
    anchors: int, *, k: int, features: int, hidden: int, inputs: int, directions: int, g: torch.Generator
) -> dict[FieldName, Tensor]:
    """A scene of random numbers without free Gaussians."""

    def numbers(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g)

    def head(outputs: int) -> Tensor:
        return numbers(hidden * (inputs + 1) + outputs * (hidden + 1)) / 4

    positions = numbers(anchors, 3)
    state: dict[FieldName, Tensor] = {
        "anchor_positions": positions[morton_order(positions, step=STEPS["anchor_positions"])],
        "offset_scales": numbers(anchors, 3),
        "base_scales": numbers(anchors, 3),
        "anchor_offsets": numbers(anchors, k, 3),
        "anchor_features": numbers(anchors, features),
        "opacity_mlp": head(k),
        "color_mlp": head(3 * k),
        "covariance_mlp": head(7 * k),
        "free": torch.zeros(0, 14),
        "free_births": torch.zeros(0, dtype=torch.int64),
        "camera_color": numbers(2, 6),
    }
    if directions:
        state |= {"appearance": torch.zeros(anchors, directions), "appearance_basis": numbers(directions, features)}
        state["environment"] = numbers(9, 3) / 4
    return state


def next_state(state: dict[FieldName, Tensor], frame: int, g: torch.Generator, *, share: float, born: int) -> None:
    """A share of the anchors moves by some steps, one value far; some free Gaussians die and ``born`` new ones come."""
    moving = torch.rand(len(state["anchor_positions"]), generator=g) < (share if frame else 1)
    names: tuple[FieldName, ...] = (*ROWS, "appearance") if "appearance" in state else ROWS
    for name in (*names, *WEIGHTS, "free"):
        value = state[name]
        active = moving if name in names else torch.rand(len(value), generator=g) < 0.8
        noise = torch.randn(value.shape, generator=g) * (2.0**-4 if name == "appearance" else 2.0**-8)
        state[name] = value + torch.where(active.reshape(-1, *[1] * (value.dim() - 1)), noise, 0)
    state["anchor_positions"][frame % len(state["anchor_positions"]), frame % 3] += 1.5 - frame
    alive = torch.rand(len(state["free"]), generator=g) < 0.8
    births = torch.arange(born, dtype=torch.int64) * (frame + 1) + (frame << 32)
    state["free"] = torch.cat([state["free"][alive], torch.randn(born, 14, generator=g)])
    state["free_births"] = torch.cat([state["free_births"][alive], births])


def header_for(state: dict[FieldName, Tensor], dynamic: frozenset[FieldName], *, distance_input: bool) -> StreamHeader:
    """Three cameras on a line, the middle one held out; the state as reference."""
    cameras = {}
    for i, name in enumerate(("left", "middle", "right")):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[0, 3], viewmat[2, 3] = 1.0 - i, 4.5
        K_matrix = torch.tensor([[40.0, 0, 24], [0, 40.25, 16], [0, 0, 1]], dtype=torch.float64)
        cameras[name] = Camera(viewmat, K_matrix, 48, 32, near=0.125)
    reference = dynamic - {"free", "free_births"}
    init_steps: dict[FieldName, float] = {
        name: STEPS.get(name, 2.0**-6) for name in state if name not in UNCODED_FIELDS
    }
    static = round_to_bins({name: value for name, value in state.items() if name not in dynamic}, init_steps)
    return StreamHeader(
        rig=CameraRig(cameras, frozenset({"middle"})),
        similarity=Similarity((0.25, -0.5, 3.0), 0.75),
        fps=30.0,
        codec="compact",
        dynamic=dynamic,
        static=static,
        distance_input=distance_input,
        config={"seed": 7},
        metadata={"capture": "fixture"},
        steps=STEPS,
        init_steps=init_steps,
        reference=dequantize_state(quantize_state(state, reference, STEPS), reference, STEPS),
    )


def stream(
    anchors: int,
    dynamic: frozenset[FieldName],
    *,
    share: float,
    born: int,
    distance_input: bool = True,
    frames: int = 7,
    wide: bool = False,
) -> tuple[bytes, list[Scene]]:
    """A whole stream and the scenes that a decoder finds in it; ``wide`` has the network sizes of real scenes."""
    g = torch.Generator().manual_seed(anchors)
    k, features, hidden = (10, 32, 32) if wide else (2, 2, 3)
    inputs, directions = features + 3 + distance_input, 3 if "appearance" in dynamic else 0
    state = first_state(anchors, k=k, features=features, hidden=hidden, inputs=inputs, directions=directions, g=g)
    header = header_for(state, dynamic, distance_input=distance_input)
    encoder, sink = SceneEncoder(header), MemorySink()
    sink.open(header)
    scenes = []
    for index in range(frames):
        next_state(state, index, g, share=share, born=0 if index == 2 else born)
        whole: dict[FieldName, Tensor] = {**state, **header.static}
        kind = PacketKind.DELTA if index % GROUP else PacketKind.KEY
        encoded = encoder.encode(
            scene_of(whole, distance_input=distance_input), index=index, pts_seconds=index / 30, kind=kind
        )
        sink.write(encoded.packet)
        scenes.append(encoded.reconstruction)
    sink.close()
    return sink.data, scenes


def write_fixture(name: str, data: bytes, scenes: list[Scene]) -> None:
    """The stream, every frame's fields as little-endian numbers one after another, and where which are."""
    numbers = b""
    frames: list[dict[str, Any]] = []
    for index, scene in enumerate(scenes):
        places: dict[str, Any] = {}
        for field, value in state_of(scene).items():
            if index and field not in PAPER_DYNAMIC | CODABLE:
                continue
            array = value.contiguous().numpy()
            places[field] = {"shape": list(array.shape), "offset": len(numbers), "bytes": array.nbytes}
            numbers += array.astype(array.dtype.newbyteorder("<")).tobytes()
        frames.append({"pts_seconds": index / 30, "key": index % GROUP == 0, "fields": places})
    (FOLDER / f"{name}.sgs").write_bytes(data)
    (FOLDER / f"{name}.bin").write_bytes(numbers)
    (FOLDER / f"{name}.json").write_text(json.dumps({"frames": frames}) + "\n")


def main() -> None:
    """Writes all fixtures, or one stream to measure with."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bench", nargs=2, metavar=("ANCHORS", "PATH"))
    bench = parser.parse_args().bench
    if bench:
        anchors, path = int(bench[0]), Path(bench[1])
        data, _ = stream(anchors, PAPER_DYNAMIC, share=0.05, born=200, wide=True)
        path.write_bytes(data)
        return
    FOLDER.mkdir(exist_ok=True)
    write_fixture("paper", *stream(41, PAPER_DYNAMIC, share=0.2, born=3))
    write_fixture("every", *stream(24, CODABLE, share=0.5, born=2, distance_input=False))
    write_fixture("tiny", *stream(4, PAPER_DYNAMIC, share=0.5, born=1, frames=3))


if __name__ == "__main__":
    main()
