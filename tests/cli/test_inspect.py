# SPDX-License-Identifier: Apache-2.0
"""The command ``inspect``: bytes by field of header and packets, listed and drawn; tables of given numbers."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.table import Table

import structgstream
from structgstream.cli import main
from structgstream.cli.inspect import (
    bit_rate_text,
    describe_capture,
    facts_table,
    header_table,
    packet_table,
    period_table,
)
from structgstream.codec.reader import open_stream
from structgstream.codec.sinks import FileSink
from structgstream.errors import CaptureError
from structgstream.evaluation.byte_count import Row
from structgstream.evaluation.run_log import append_log, begin_log
from structgstream.scene.appearance import with_appearance
from structgstream.scene.state import PAPER_DYNAMIC, FieldName
from tests.support.consoles import console, text
from tests.support.drawn import pixels_of
from tests.support.quick_streams import Runner
from tests.support.rigs import random_scene
from tests.support.streams import compact_header, header_for, moved, write_stream

FRAMES = 31


@pytest.fixture(scope="module")
def streams(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One of codec ``compact`` with everything in motion, and one of codec ``raw``; a key packet at every third."""
    folder = tmp_path_factory.mktemp("inspect")
    scene = with_appearance(random_scene(40, free=3, seed=2), 3)
    scenes = [moved(scene, i) for i in range(FRAMES)]
    dynamic: frozenset[FieldName] = frozenset({*PAPER_DYNAMIC, "base_scales", "appearance"})
    headers = {"compact": compact_header(scene, dynamic=dynamic), "raw": header_for(scene)}
    for codec, header in headers.items():
        write_stream(FileSink(folder / f"{codec}.sgs"), scenes, header=header)
    return {codec: folder / f"{codec}.sgs" for codec in headers}


CLIP = Path(structgstream.__file__).parent / "data/clip"


def shown(arguments: list[str], run: Runner) -> list[list[str]]:
    """What ``inspect`` prints, as the words of each line."""
    text = run(["inspect", *arguments]).out
    assert max(map(len, text.splitlines())) <= 80 or "--plot" in arguments
    assert "…" not in text
    return [line.split() for line in text.splitlines()]


def numbers(words: list[str]) -> list[int]:
    return [int(word.replace(",", "")) for word in words]


@pytest.mark.parametrize("codec", ["compact", "raw"])
def test_every_number_of_the_table_is_whole_on_80_characters(
    streams: dict[str, Path], codec: str, run: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = shown([str(streams[codec]), "--all-packets"], run)
    packets = [line for line in lines if len(line) > 2 and line[0].isdigit() and line[1] in ("key", "delta")]
    infos = open_stream(streams[codec]).packets
    assert [line[0] for line in packets] == [str(i) for i in range(FRAMES)]
    for line, info in zip(packets, infos, strict=True):
        whole, *fields = numbers(line[2:])
        assert whole == info.bytes == sum(fields)
        assert sorted(fields) == sorted([*info.field_bytes.values(), info.bytes - sum(info.field_bytes.values())])
    means = {line[1]: numbers(line[2:])[0] for line in lines if line[:1] == ["mean"]}
    deltas = [info.bytes for i, info in enumerate(infos) if i % 3]
    keys = [info.bytes for i, info in enumerate(infos) if i % 3 == 0 < i]
    assert means == {"key": round(sum(keys) / len(keys)), "delta": round(sum(deltas) / len(deltas))}


def test_a_long_stream_is_listed_in_even_steps(streams: dict[str, Path], run: Runner) -> None:
    lines = shown([str(streams["raw"])], run)
    listed = [int(line[0]) for line in lines if len(line) > 2 and line[1] in ("key", "delta") and line[0] != "mean"]
    assert listed == [*range(0, FRAMES, 2)]
    assert any("1 in 2 is listed" in " ".join(line) for line in lines)


def test_a_picture_of_the_bytes(streams: dict[str, Path], tmp_path: Path, run: Runner) -> None:
    picture = tmp_path / "new" / "bytes.png"
    lines = shown([str(streams["compact"]), "--plot", str(picture)], run)
    assert ["Wrote", str(picture)] in lines
    assert pixels_of(picture).shape[1] > 1000
    assert main(["inspect", str(streams["raw"]), "--plot", str(tmp_path / "x.svg")]) == 0
    assert "<svg" in (tmp_path / "x.svg").read_text()


def test_pictures_that_cannot_be(streams: dict[str, Path], tmp_path: Path, run: Runner) -> None:
    plot = ["inspect", str(streams["raw"]), "--plot"]
    assert "must be one of .png" in run([*plot, str(tmp_path / "x.gifx")], status=2).err
    empty = tmp_path / "empty.sgs"
    reader = open_stream(streams["raw"])
    empty.write_bytes(streams["raw"].read_bytes()[: reader.header_bytes])
    assert "no whole frame" in run(["inspect", str(empty), "--plot", str(tmp_path / "x.png")], status=2).err
    assert main(["inspect", str(empty)]) == 0
    (tmp_path / "file").write_text("")
    assert "cannot be written" in run([*plot, str(tmp_path / "file" / "x.png")], status=1).err


def test_damage_is_reported_and_what_follows_it_is_listed(
    streams: dict[str, Path], tmp_path: Path, run: Runner
) -> None:
    data = bytearray(streams["compact"].read_bytes())
    lost = open_stream(streams["compact"]).packets[4]
    data[lost.offset + 30] ^= 1  # Frame 6 is the next key packet.
    damaged = tmp_path / "damaged.sgs"
    damaged.write_bytes(data)
    lines = shown([str(damaged), "--all-packets", "--json", str(tmp_path / "i.json")], run)
    listed = [int(line[0]) for line in lines if len(line) > 2 and line[1] in ("key", "delta") and line[0] != "mean"]
    assert listed == [0, 1, 2, 3, *range(6, FRAMES)]
    state = " ".join(" ".join(line) for line in lines)
    assert f"damaged: the record at byte {lost.offset} of" in state
    assert "2 of 31 frames are lost" in state
    content = json.loads((tmp_path / "i.json").read_text())
    assert content["header"]["damage"] == [{"offset": lost.offset, "first": 4, "end": 6}]
    assert [packet["index"] for packet in content["packets"]] == listed


def test_what_came_and_went_is_reported_where_the_log_is(streams: dict[str, Path], tmp_path: Path, run: Runner) -> None:
    stream = tmp_path / "logged.sgs"
    stream.write_bytes(streams["raw"].read_bytes())
    assert not any(words[:1] == ["came,"] for words in shown([str(stream)], run))
    begin_log(stream)
    with open_stream(stream) as reader:
        sizes = [info.bytes for info in reader.packets]
    append_log(stream, {"index": 0, "bytes": sizes[0], "grown": 1_200, "removed": 30, "spawned": 0, "pruned": 0})
    append_log(stream, {"index": 2, "bytes": sizes[2], "grown": 0, "removed": 0, "spawned": 5, "pruned": 4})
    output = tmp_path / "out.json"
    lines = shown([str(stream), "--json", str(output)], run)
    reported = " ".join(next(words for words in lines if words[:1] == ["came,"]))
    assert "anchors (+1,200 -30), free Gaussians (+5 -4)" in reported
    packets = json.loads(output.read_text())["packets"]
    assert packets[0]["changes"] == {"grown": 1_200, "removed": 30, "spawned": 0, "pruned": 0}
    assert packets[1]["changes"] == {}


def test_inspect_prints_the_resolved_configuration(stream: Path, run: Runner) -> None:
    assert json.loads(run(["inspect", str(stream), "--config"]).out)["online"]["iterations"] == 2


def test_a_capture_is_described_without_training(tmp_path: Path) -> None:
    content = describe_capture(CLIP)
    assert (content["layout"], content["frames"], content["fps"]) == ("json videos", 12, 30)
    own = content["cameras"]["cam03"]
    assert (own["size"], own["lens"], own["frames"], own["first_seconds"]) == ((320, 240), "pinhole", 12, 0)
    assert own["last_seconds"] == pytest.approx(11 / 30, abs=1e-3)
    assert "BT.709" in own["colors"]
    shutil.copytree(CLIP, tmp_path / "clip")
    (tmp_path / "clip" / "cam03.mp4").unlink()
    with pytest.raises(CaptureError, match="cam03"):
        describe_capture(tmp_path / "clip")


def test_videos_without_calibration_are_described_as_prepare_reads_them(tmp_path: Path) -> None:
    for name in ("cam00", "cam03"):
        shutil.copy(CLIP / f"{name}.mp4", tmp_path)
    content = describe_capture(tmp_path)
    assert (content["layout"], content["frames"]) == ("videos or pictures without calibration", 12)
    assert content["cameras"]["cam03"]["size"] == (320, 240)
    assert "structgstream prepare" in content["remarks"][-1]
    (tmp_path / "cam03.mp4").unlink()
    (tmp_path / "cam00.mp4").rename(tmp_path / "notes.txt")
    with pytest.raises(CaptureError, match="no supported layout"):
        describe_capture(tmp_path)


HEADER: dict[str, Any] = {
    "metadata": {"capture": "hall [1]"},
    "codec": "compact",
    "fps": 25.0,
    "cameras": {
        "a": {"held_out": True, "width": 64, "height": 48},
        "b": {"held_out": False, "width": 32, "height": 48},
    },
    "total_bytes": 5000,
    "header_bytes": 1000,
    "fields": {"free": {"bytes": 0, "shape": [0, 14]}, "offset_scales": {"bytes": 240, "shape": [20, 3]}},
    "dynamic": ["free"],
    "damage": [],
    "complete": True,
    "cut_reason": None,
    "period": 0,
    "periods": [{}],
}


def rows(count: int, *, bytes: int = 100) -> list[Row]:
    sizes = {"free": bytes - 10}
    return [Row(i, "delta" if i else "key", i / 25, 1000 + i * bytes, bytes, sizes, first=i == 0) for i in range(count)]


def lines_of(table: Table) -> list[str]:
    to = console(width=100)
    to.print(table)
    return [" ".join(line.split()) for line in text(to).splitlines() if line.strip()]


def packet(changes: dict[str, int], counts: dict[str, int]) -> dict[str, Any]:
    return {"changes": changes, "counts": counts}


def test_what_a_stream_is_in_a_line_for_each_fact() -> None:
    packets = [
        packet({"grown": 5, "removed": 2}, {"displaced": 3}),
        packet({"spawned": 4}, {"displaced": 4, "scene cuts": 0}),
    ]
    lines = lines_of(facts_table(HEADER, rows(2), packets=packets))
    for line in (
        "capture hall [1]",
        "frames 2 at 25 a second, 0.08 s",
        "cameras 2 of 32x48, 64x48; held out: a",
        "size 5.0 kB, header 1.0 kB",
        "rate 0.02 Mbit/s without the header",
        "came, went anchors (+5 -2), free Gaussians (+4 -0), says the log",
        "acts displaced 7, scene cuts 0",
        "state complete: its run ended or was stopped in order",
    ):
        assert line in lines


@pytest.mark.parametrize(("damage", "state"), [([], "not finished"), ([{"offset": 1}], "damaged")])
def test_a_stream_that_is_not_whole_says_why(damage: list[dict[str, int]], state: str) -> None:
    header = HEADER | {"damage": damage, "complete": False, "cut_reason": "it ends in frame 3"}
    lines = lines_of(facts_table(header, [], packets=[]))
    assert f"state {state}: it ends in frame 3" in lines
    assert not [line for line in lines if line.startswith(("rate ", "came, ", "acts "))]


def test_the_rate_by_hand() -> None:
    """50 kB a frame, 25 times a second, 8 bits each; with a frame in 2 s instead, three in 4.04 s."""
    assert bit_rate_text(rows(3, bytes=50_000), 25.0) == "10.00 Mbit/s without the header"
    sparse = [replace(row, pts_seconds=2.0 * row.index) for row in rows(3, bytes=50_000)]
    assert bit_rate_text(sparse, 25.0) == "0.30 Mbit/s without the header"
    assert "frames 3, at most 25 a second, 4.04 s" in lines_of(facts_table(HEADER, sparse, packets=[]))


def test_the_header_by_field_the_largest_first() -> None:
    lines = lines_of(header_table(HEADER))
    assert lines[-3:] == ["offset scales 20 x 3 240 24.0% 32.00", "free 0 x 14 0 0.0% -", "the rest 760 76.0%"]


def test_large_packets_are_reported_in_kilobytes() -> None:
    assert "packets, bytes" in lines_of(packet_table(rows(2), every=True))[0]
    large = lines_of(packet_table(rows(2, bytes=250_000), every=True))
    assert "packets, kB" in large[0]
    assert any(line.startswith("1 delta 250.0") for line in large)


def test_periods_have_a_row_each_where_there_are_several() -> None:
    fields = {"anchor_positions": {"bytes": 9, "shape": [4321, 3]}}
    one = {"period": 0, "first_frame": 0, "frames": 8, "seconds": 0.32, "header_bytes": 1200, "packet_bytes": 500}
    first = one | {"begins": None, "fields": fields}
    later = one | {"period": 1, "first_frame": 8, "begins": "residual 1.71 times the first frame's", "fields": {}}
    assert period_table([first]) is None
    table = period_table([first, later])
    lines = lines_of(table)
    assert "0 0 8 0.32 4,321 1.2 kB 500 B -" in lines
    assert "1 8 8 0.32 - 1.2 kB 500 B residual 1.71 times the first frame's" in lines
    header = HEADER | {"periods": [first, later]}
    assert "size 5.0 kB, 2 headers 1.0 kB" in lines_of(facts_table(header, rows(2), packets=[]))
