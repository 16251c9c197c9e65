# SPDX-License-Identifier: Apache-2.0
"""The command ``inspect``: bytes by field of header and packets, listed and drawn."""

import json
import shutil
from pathlib import Path

import pytest

import structgstream
from structgstream.cli import main
from structgstream.cli.inspect import describe_capture
from structgstream.codec.reader import open_stream
from structgstream.codec.sinks import FileSink
from structgstream.errors import CaptureError
from structgstream.evaluation.run_log import append_log, begin_log
from structgstream.scene.appearance import with_appearance
from structgstream.scene.state import PAPER_DYNAMIC, FieldName
from tests.support.drawn import pixels_of
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


def shown(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> list[list[str]]:
    """What ``inspect`` prints, as the words of each line."""
    capsys.readouterr()
    assert main(["inspect", *arguments]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80 or "--plot" in arguments
    assert "…" not in text
    return [line.split() for line in text.splitlines()]


def numbers(words: list[str]) -> list[int]:
    return [int(word.replace(",", "")) for word in words]


@pytest.mark.parametrize("codec", ["compact", "raw"])
def test_every_number_of_the_table_is_whole_on_80_characters(
    streams: dict[str, Path], codec: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = shown([str(streams[codec]), "--all-packets"], capsys)
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


def test_a_long_stream_is_listed_in_even_steps(streams: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    lines = shown([str(streams["raw"])], capsys)
    listed = [int(line[0]) for line in lines if len(line) > 2 and line[1] in ("key", "delta") and line[0] != "mean"]
    assert listed == [*range(0, FRAMES, 2)]
    assert any("1 in 2 is listed" in " ".join(line) for line in lines)


def test_a_picture_of_the_bytes(streams: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "new" / "bytes.png"
    lines = shown([str(streams["compact"]), "--plot", str(picture)], capsys)
    assert ["Wrote", str(picture)] in lines
    assert pixels_of(picture).shape[1] > 1000
    assert main(["inspect", str(streams["raw"]), "--plot", str(tmp_path / "x.svg")]) == 0
    assert "<svg" in (tmp_path / "x.svg").read_text()


def test_pictures_that_cannot_be(streams: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(streams["raw"]), "--plot", str(tmp_path / "x.gifx")]) == 2
    assert "must be one of .png" in capsys.readouterr().err
    empty = tmp_path / "empty.sgs"
    reader = open_stream(streams["raw"])
    empty.write_bytes(streams["raw"].read_bytes()[: reader.header_bytes])
    assert main(["inspect", str(empty), "--plot", str(tmp_path / "x.png")]) == 2
    assert "no whole frame" in capsys.readouterr().err
    assert main(["inspect", str(empty)]) == 0
    (tmp_path / "file").write_text("")
    assert main(["inspect", str(streams["raw"]), "--plot", str(tmp_path / "file" / "x.png")]) == 1
    assert "cannot be written" in capsys.readouterr().err


def test_damage_is_reported_and_what_follows_it_is_listed(
    streams: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(streams["compact"].read_bytes())
    lost = open_stream(streams["compact"]).packets[4]
    data[lost.offset + 30] ^= 1  # Frame 6 is the next key packet.
    damaged = tmp_path / "damaged.sgs"
    damaged.write_bytes(data)
    lines = shown([str(damaged), "--all-packets", "--json", str(tmp_path / "i.json")], capsys)
    listed = [int(line[0]) for line in lines if len(line) > 2 and line[1] in ("key", "delta") and line[0] != "mean"]
    assert listed == [0, 1, 2, 3, *range(6, FRAMES)]
    state = " ".join(" ".join(line) for line in lines)
    assert f"damaged: the record at byte {lost.offset} of" in state
    assert "2 of 31 frames are lost" in state
    content = json.loads((tmp_path / "i.json").read_text())
    assert content["header"]["damage"] == [{"offset": lost.offset, "first": 4, "end": 6}]
    assert [packet["index"] for packet in content["packets"]] == listed


def test_what_came_and_went_is_reported_where_the_log_is(
    streams: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stream = tmp_path / "logged.sgs"
    stream.write_bytes(streams["raw"].read_bytes())
    assert not any(words[:1] == ["came,"] for words in shown([str(stream)], capsys))
    begin_log(stream)
    with open_stream(stream) as reader:
        sizes = [info.bytes for info in reader.packets]
    append_log(stream, {"index": 0, "bytes": sizes[0], "grown": 1_200, "removed": 30, "spawned": 0, "pruned": 0})
    append_log(stream, {"index": 2, "bytes": sizes[2], "grown": 0, "removed": 0, "spawned": 5, "pruned": 4})
    output = tmp_path / "out.json"
    lines = shown([str(stream), "--json", str(output)], capsys)
    reported = " ".join(next(words for words in lines if words[:1] == ["came,"]))
    assert "anchors (+1,200 -30), free Gaussians (+5 -4)" in reported
    packets = json.loads(output.read_text())["packets"]
    assert packets[0]["changes"] == {"grown": 1_200, "removed": 30, "spawned": 0, "pruned": 0}
    assert packets[1]["changes"] == {}


def test_inspect_prints_the_resolved_configuration(stream: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["inspect", str(stream), "--config"]) == 0
    assert json.loads(capsys.readouterr().out)["online"]["iterations"] == 2


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
