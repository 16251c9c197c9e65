# SPDX-License-Identifier: Apache-2.0
"""The compact codec from scene to file and back."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from structgstream.codec.container.blocks import unpack_blocks
from structgstream.codec.container.records import FRAME, scan_records
from structgstream.codec.fields.packet_fields import CODABLE
from structgstream.codec.packets import (
    Packet,
    PacketKind,
    StreamHeader,
    check_shapes,
    pack_header,
    parse_packet,
    unpack_header,
)
from structgstream.codec.reader import StreamReader
from structgstream.codec.scene_coder import CompactCoder, SceneDecoder, SceneEncoder
from structgstream.codec.sinks import MemorySink
from structgstream.errors import StreamError
from structgstream.scene.appearance import with_appearance
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.scene.state import PAPER_DYNAMIC, FieldName, flatten_head, scene_of, state_of
from tests.support.properties import thinned
from tests.support.rigs import random_scene
from tests.support.streams import STATIC_STEP, compact_header, flipped, same, small_scene

FREE: frozenset[FieldName] = frozenset({"free", "free_births"})
DYNAMICS: list[frozenset[FieldName]] = [
    PAPER_DYNAMIC,
    CODABLE,
    FREE,
    frozenset(),
    frozenset({"anchor_positions"}),
    frozenset({"color_mlp", "base_scales"}),
]


def next_scene(scene: Scene, frame: int, *, dynamic: frozenset[FieldName], g: torch.Generator) -> Scene:
    """A third of the rows of everything dynamic moves; of free Gaussians a fifth dies and up to three are spawned."""
    state = dict(state_of(scene))
    for name in dynamic - FREE:
        value = state[name]
        which = torch.rand(value.shape[:1], generator=g) < 0.3
        step = torch.randn(value.shape, generator=g) * 0.1
        state[name] = torch.where(which.reshape(-1, *[1] * (value.dim() - 1)), value + step, value)
    if "free" in dynamic:
        alive = torch.rand(len(scene.free), generator=g) > 0.2
        spawned = int(torch.randint(0, 4, (), generator=g))
        moved = state["free"] + (torch.rand(len(alive), 1, generator=g) < 0.3) * torch.randn(
            len(alive), 14, generator=g
        )
        state["free"] = torch.cat([moved[alive], torch.randn(spawned, 14, generator=g)])
        state["free_births"] = torch.cat([state["free_births"][alive], (frame + 2**10) * 2**32 + torch.arange(spawned)])
    return scene_of(state, distance_input=scene.distance_input)


def story(first: Scene, frames: int, *, dynamic: frozenset[FieldName] = PAPER_DYNAMIC, seed: int = 0) -> list[Scene]:
    g = torch.Generator().manual_seed(seed)
    scenes = [first]
    for frame in range(1, frames):
        scenes.append(next_scene(scenes[-1], frame, dynamic=dynamic, g=g))
    return scenes


def written(
    scenes: list[Scene], header: StreamHeader, *, keys: tuple[int, ...] = (0, 3)
) -> tuple[bytes, list[Scene], list[Packet]]:
    """The file, what the encoder says a reader will see, and the packets."""
    sink, encoder = MemorySink(), SceneEncoder(header)
    sink.open(header)
    seen, packets = [], []
    for i, scene in enumerate(scenes):
        kind = PacketKind.KEY if i in keys else PacketKind.DELTA
        encoded = encoder.encode(scene, index=i, pts_seconds=i / 30.0, kind=kind)
        sink.write(encoded.packet)
        seen.append(encoded.reconstruction)
        packets.append(encoded.packet)
    sink.close()
    return sink.data, seen, packets


@cache
def small() -> tuple[StreamHeader, bytes, list[Scene], list[Packet]]:
    """Five frames of three anchors and a few free Gaussians; two groups."""
    first = small_scene(3, free=2)
    header = compact_header(first)
    return header, *written(story(first, 5), header)


@pytest.mark.parametrize(
    ("anchors", "dynamic"),
    [(0, CODABLE), (1, CODABLE), *((20, dynamic) for dynamic in DYNAMICS)],
    ids=lambda value: str(value) if isinstance(value, int) else "+".join(sorted(value)) or "nothing",
)
def test_a_reader_sees_what_the_encoder_says(anchors: int, dynamic: frozenset[FieldName]) -> None:
    first = random_scene(anchors, free=20 if dynamic >= FREE else 0, seed=3)
    if "appearance" in dynamic:
        first = with_appearance(first, 5)
    header = compact_header(first, dynamic=dynamic)
    scenes = story(first, 5, dynamic=dynamic)
    data, seen, _ = written(scenes, header)
    reader = StreamReader(data)
    for (_, scene), expected, true in zip(reader.scenes(), seen, scenes, strict=True):
        assert same(scene, expected)
        state, wanted = state_of(scene), state_of(true)
        assert torch.equal(state["free_births"], wanted["free_births"] if "free" in dynamic else torch.zeros(0))
        for name in dynamic - {"free_births"}:
            assert torch.allclose(state[name], wanted[name], atol=2.0**-7, rtol=0), name
    for name in state_of(first).keys() - dynamic:
        assert torch.allclose(state_of(seen[-1])[name], state_of(first)[name], atol=STATIC_STEP / 2, rtol=0), name
        assert torch.equal(state_of(seen[-1])[name], state_of(seen[0])[name]), name


def test_forwards_backwards_and_twice() -> None:
    _, data, seen, _ = small()
    for order in (range(5), range(4, -1, -1), [3, 3, 4, 4, 0, 4, 1]):
        reader = StreamReader(data, by_index=True)
        assert all(same(reader.scene(i), seen[i]) for i in order)


def test_a_group_stands_alone() -> None:
    header, _, seen, packets = small()
    decoder = SceneDecoder(header)
    for index in (3, 4, 0, 1, 2, 3):
        assert same(decoder.decode(packets[index]), seen[index])


def test_a_packet_out_of_order() -> None:
    header, _, seen, packets = small()
    decoder = SceneDecoder(header)
    with pytest.raises(StreamError, match="Packet 1 needs packet 0, which was not decoded before it"):
        decoder.decode(packets[1])
    decoder.decode(packets[0])
    with pytest.raises(StreamError, match="Packet 2 needs packet 1"):
        decoder.decode(packets[2])
    assert same(decoder.decode(packets[1]), seen[1]), "the packet before is still known"
    with pytest.raises(StreamError, match="Packet 1 needs packet 0"):
        decoder.decode(packets[1])


def test_an_encoder_keeps_the_order_as_well() -> None:
    first = small_scene()
    encoder = CompactCoder(compact_header(first))
    with pytest.raises(StreamError, match="Packet 0 needs packet -1"):
        encoder.encode(state_of(first), kind=PacketKind.DELTA, index=0)
    encoder.encode(state_of(first), kind=PacketKind.KEY, index=0)
    with pytest.raises(StreamError, match="Packet 2 needs packet 1"):
        encoder.encode(state_of(first), kind=PacketKind.DELTA, index=2)


def test_a_scene_of_another_size_is_refused() -> None:
    encoder = CompactCoder(compact_header(small_scene(3)))
    with pytest.raises(StreamError, match="Frame 0 has 4 anchors, the header 3"):
        encoder.encode(state_of(small_scene(4)), kind=PacketKind.KEY, index=0)
    state: dict[FieldName, torch.Tensor] = {**state_of(small_scene(3)), "covariance_mlp": torch.zeros(7)}
    with pytest.raises(StreamError, match="Frame 0 has covariance_mlp of another size"):
        encoder.encode(state, kind=PacketKind.KEY, index=0)


def test_what_stands_still_keeps_its_bins_and_costs_next_to_nothing() -> None:
    first = random_scene(100, free=20, seed=1)
    header = compact_header(first)
    _data, seen, packets = written([first] * 4, header, keys=(0,))
    assert all(same(seen[0], scene) for scene in seen[1:])
    assert [len(packet.payload) < 240 for packet in packets] == [False, True, True, True]
    # From what is drawn to the file nothing is rounded a second time.
    again = written([seen[0]] * 2, header, keys=(0,))[1]
    assert same(again[1], seen[0])


def without(header: StreamHeader, name: str) -> dict[str, float]:
    return {key: step for key, step in header.steps.items() if key != name}


def test_a_header_that_does_not_fit_the_codec() -> None:
    header = compact_header(small_scene(3, free=2))
    reference = {name: value for name, value in header.reference.items() if name != "offset_scales"}
    for wrong, message in (
        (replace(header, steps=without(header, "free_quats")), "no step for free_quats"),
        (replace(header, steps=without(header, "offset_scales")), "no step for offset_scales"),
        (replace(header, reference=reference), "reference state does not hold the dynamic fields"),
        (replace(header, reference={**header.reference, "base_scales": torch.zeros(3, 3)}), "reference state does not"),
        (replace(header, dynamic=PAPER_DYNAMIC - {"free_births"}), "free Gaussians without their births"),
        (replace(header, dynamic=PAPER_DYNAMIC | {"camera_color"}), "no coding for camera_color; keep it static"),
        (
            replace(header, reference={**header.reference, "anchor_positions": torch.full((3, 3), float("nan"))}),
            "steps from zero",
        ),
    ):
        with pytest.raises(StreamError, match=message):
            SceneDecoder(wrong)


@pytest.mark.parametrize("step", [0.0, -1.0, 0.1, 2.0**-65, 2.0**65, 1e300, "1", True, None])
def test_a_step_that_is_none(step: object) -> None:
    header = compact_header(small_scene())
    with pytest.raises(StreamError, match="The init record does not follow the format"):
        unpack_header(pack_header(replace(header, steps={**header.steps, "free_quats": step})))  # type: ignore[dict-item]


def test_a_value_out_of_range() -> None:
    first = small_scene()
    encoder = SceneEncoder(compact_header(first))
    far = replace(first, anchors=replace(first.anchors, positions=first.anchors.positions + 1e6))
    with pytest.raises(StreamError, match="steps from zero, at most 4194304 can be coded"):
        encoder.encode(far, index=0, pts_seconds=0.0, kind=PacketKind.KEY)
    assert encoder.encode(first, index=0, pts_seconds=0.0, kind=PacketKind.KEY).packet.index == 0


def test_a_raw_block_in_a_compact_packet_and_the_other_way_round() -> None:
    header, _, _, packets = small()
    scene = small_scene(3, free=2)
    raw = replace(header, codec="raw", steps={}, reference={})
    packet = SceneEncoder(raw).encode(scene, index=0, pts_seconds=0.0, kind=PacketKind.KEY).packet
    with pytest.raises(StreamError, match="holds field anchor_positions raw; expected coded"):
        SceneDecoder(header).decode(packet)
    with pytest.raises(StreamError, match="holds field anchor_positions coded; expected raw"):
        SceneDecoder(raw).decode(packets[0])


@pytest.mark.parametrize("index", range(5))
def test_every_byte_of_a_packet_changed_gives_a_scene_or_one_kind_of_error(index: int) -> None:
    """With the checksum out of the way, the decoders see it all."""
    header, _, seen, packets = small()
    decoder = CompactCoder(header)
    for packet in packets[(index // 3) * 3 : index]:
        decoder.decode(unpack_blocks(packet.payload, FRAME.size, where="")[1], kind=packet.kind, index=packet.index)
    state, failed, different = decoder.state, 0, 0
    for byte in range(FRAME.size, len(packets[index].payload)):
        decoder.state, payload = state, flipped(packets[index].payload, 8 * byte + byte % 8)
        try:
            packet = parse_packet(payload, packets[index].kind)
            found = decoder.decode(unpack_blocks(payload, FRAME.size, where="")[1], kind=packet.kind, index=index)
        except StreamError:
            failed += 1
            continue
        check_shapes({**header.static, **found}, distance_input=True, training_cameras=2, where="")
        different += any(not torch.equal(value, state_of(seen[index])[name]) for name, value in found.items())
    assert failed > 50
    assert different > 0, "the checksum is there for what decodes to something else"


def test_every_byte_of_an_init_record_changed_gives_a_decoder_or_one_kind_of_error() -> None:
    _, data, _, packets = small()
    payload, failed = next(scan_records(data)).payload, 0
    places = thinned(range(len(payload)))
    for byte in places:
        try:
            scene = SceneDecoder(unpack_header(flipped(payload, 8 * byte + byte % 8))).decode(packets[0])
        except StreamError:
            failed += 1
            continue
        assert len(scene.anchors) == 3
    assert len(places) // 3 < failed < len(places)


@pytest.mark.parametrize("field", sorted(PAPER_DYNAMIC))
def test_truncated_fields(field: FieldName) -> None:
    """Each field cut at each of its bytes, and with one more; now and then a cut one is a code of something else."""
    header, _, seen, _ = small()
    coded = CompactCoder(header).encode(state_of(seen[0]), kind=PacketKind.KEY, index=0)
    decoder = SceneDecoder(header)._compact
    failed, cuts = 0, [coded[field][:end] for end in range(len(coded[field]))]
    for data in cuts:
        try:
            found = decoder.decode({**coded, field: data}, kind=PacketKind.KEY, index=0)
        except StreamError:
            failed += 1
            continue
        check_shapes({**header.static, **found}, distance_input=True, training_cameras=2, where="")
    assert failed >= len(cuts) - 1 - len(cuts) // 20
    with pytest.raises(StreamError, match="Packet 0"):
        decoder.decode({**coded, field: coded[field] + b"\0"}, kind=PacketKind.KEY, index=0)
    assert decoder.decode(coded, kind=PacketKind.KEY, index=0).keys() == PAPER_DYNAMIC


def test_values_stay_within_range_over_frames() -> None:
    """A residual that leads beyond 22 bits is damage."""
    far = small_scene()
    positions = far.anchors.positions + 2.0**16 - 100.0
    positions[0, 0] = 2.0**16  # the last bin
    far = replace(far, anchors=replace(far.anchors, positions=positions))
    header = compact_header(far)
    assert same(StreamReader(written([far], header)[0]).scene(0), written([far], header)[1][0])
    near = {**header.reference, "anchor_positions": far.anchors.positions - 1.0}
    first = (
        SceneEncoder(replace(header, reference=near)).encode(far, index=0, pts_seconds=0, kind=PacketKind.KEY).packet
    )
    with pytest.raises(StreamError, match="Packet 0 has a bin beyond 22 bits"):
        SceneDecoder(header).decode(first)


def test_an_mlp_that_moves_and_free_gaussians_that_none_has() -> None:
    first = small_scene(2)
    head = first.mlps.opacity
    moving = replace(first, mlps=first.mlps._replace(opacity=head._replace(b2=head.b2 + 0.5)))
    dynamic: frozenset[FieldName] = frozenset({"opacity_mlp", *FREE})
    seen = written([first, moving], compact_header(first, dynamic=dynamic))[1]
    assert torch.allclose(flatten_head(seen[1].mlps.opacity), flatten_head(moving.mlps.opacity), atol=2.0**-7)
    assert len(seen[1].free) == 0
    assert isinstance(seen[1].free, FreeGaussians)
