# SPDX-License-Identifier: Apache-2.0
"""Sound through the commands: reconstructed, continued, in segments, rendered; and what cannot be."""

import shutil
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest

from structgstream import recorder
from structgstream.api import reconstruct
from structgstream.cli import main, render
from structgstream.cli.render import write_pictures
from structgstream.codec.packets import PacketKind
from structgstream.codec.reader import open_stream
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.segments.stored_bytes import write_archive
from structgstream.codec.sinks import FileSink
from structgstream.codec.sound import FrameSound, frame_sound
from structgstream.data.sound import SoundFile
from structgstream.data.timeline import Clock
from structgstream.recorder import SoundSink
from tests.support.backends import QUICKEST
from tests.support.quick_streams import CLIP, QUARTER, Runner
from tests.support.sounds import APART_SECONDS, LOUD, add_sound, claps, stream_heard, write_sound
from tests.vectors.generate import SOUND_STREAM

pytestmark = pytest.mark.usefixtures("quick_tiny")

FRAMES = 6
MILLISECOND = 1e-3
MOST_SECONDS = 0.04


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The clip; cam03 hears a clap at 0.1 s, cam04 in two channels, cam05 nothing after 0.05 s."""
    folder = tmp_path_factory.mktemp("heard") / "clip"
    shutil.copytree(CLIP, folder)
    given = {"cam03": claps(0.4, 0.1), "cam04": claps(0.4, 0.1, channels=2), "cam05": claps(0.05, 0.02)}
    for name, samples in given.items():
        (folder / f"{name}.mp4").unlink()
        add_sound(Path(CLIP) / f"{name}.mp4", folder / f"{name}.mp4", samples)
    return folder


def made(capture: Path, output: Path, *more: str, frames: int = FRAMES) -> Path:
    assert main(["reconstruct", str(capture), "-o", str(output), "--frames", str(frames), *QUARTER, *more]) == 0
    return output


@pytest.fixture(scope="module")
def stream(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(capture, tmp_path_factory.mktemp("stream") / "claps.sgs", "--sound", "cam03")


def test_the_clap_is_where_it_was_filmed(stream: Path) -> None:
    with open_stream(stream) as reader:
        assert reader.complete
        assert reader.header.metadata["sound"] == "cam03"
        assert stream_heard(reader) == pytest.approx([0.1], abs=MILLISECOND)


def test_without_sound_there_is_no_byte_more(capture: Path, tmp_path: Path, stream: Path) -> None:
    silent = made(capture, tmp_path / "silent.sgs")
    before = made(Path(CLIP), tmp_path / "before.sgs")
    assert silent.read_bytes() == before.read_bytes()
    with open_stream(silent) as reader, open_stream(stream) as heard:
        for index in range(FRAMES):
            assert [*reader.group(index)][-1] == [*heard.group(index)][-1], "pictures do not depend on sound"


def test_sound_is_added_to_a_stream_that_has_none(capture: Path, tmp_path: Path, stream: Path, run: Runner) -> None:
    silent, heard = made(Path(CLIP), tmp_path / "silent.sgs"), tmp_path / "heard.sgs"
    arguments = ["add-sound", str(silent), str(capture), "-o", str(heard)]
    assert main([*arguments, "--sound", "cam03"]) == 0
    assert heard.read_bytes() == stream.read_bytes()
    assert "exists; replace it with --overwrite" in run(arguments, status=2).err
    again = ["add-sound", str(heard), str(capture), "-o", str(tmp_path / "x.sgs"), "--sound", "cam03"]
    assert "heard.sgs has sound; take a stream without it" in run(again, status=1).err
    assert main([*arguments[:-1], str(tmp_path / "y.sgs"), "--sound", "cam04"]) == 0
    with open_stream(tmp_path / "y.sgs") as reader:
        assert stream_heard(reader) == pytest.approx([0.1], abs=MILLISECOND)


def test_sound_that_is_interrupted_leaves_no_half_stream(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    silent, heard = made(Path(CLIP), tmp_path / "silent.sgs"), tmp_path / "heard.sgs"
    heard.write_bytes(b"another")
    arguments = ["add-sound", str(silent), str(capture), "-o", str(heard), "--sound", "cam03", "--overwrite"]

    def interrupted(index: int, *rest: object) -> FrameSound:
        if index == 2:
            raise KeyboardInterrupt
        return frame_sound(index, *rest)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(recorder, "frame_sound", interrupted)
    with suppress(KeyboardInterrupt):
        assert main(arguments) != 0
    assert heard.read_bytes() == b"another"
    assert sorted(file.name for file in tmp_path.glob("heard*")) == ["heard.sgs"]


def test_a_part_of_the_capture_is_in_step(capture: Path, tmp_path: Path) -> None:
    reconstruct(
        capture, tmp_path / "part.sgs", preset="tiny", backend=QUICKEST, scale=0.25, start=2, frames=2, sound="cam04"
    )
    with open_stream(tmp_path / "part.sgs") as reader:
        assert reader.header.sound.channels == 2
        assert stream_heard(reader) == pytest.approx([0.1 - 2 / 30], abs=MILLISECOND)


def test_it_continues_where_it_was_killed(capture: Path, tmp_path: Path, stream: Path) -> None:
    whole = stream.read_bytes()
    with open_stream(stream) as reader:
        info = reader.packets[3]
    for cut in (info.offset, info.offset + info.bytes - 5, info.offset + info.bytes):
        path = tmp_path / f"{cut}.sgs"
        path.write_bytes(whole[:cut])
        made(capture, path, "--sound", "cam03", "--resume")
        assert path.read_bytes() == whole


def test_another_sound_does_not_continue_it(capture: Path, tmp_path: Path, stream: Path, run: Runner) -> None:
    path = tmp_path / "cut.sgs"
    path.write_bytes(stream.read_bytes()[:-200])
    for more in ([], ["--sound", "cam04"]):
        arguments = ["reconstruct", str(capture), "-o", str(path), "--frames", str(FRAMES), *QUARTER, "--resume", *more]
        assert "another part of it: sound differ" in run(arguments, status=1).err


def test_segments_are_the_file_also_in_qualities(capture: Path, tmp_path: Path, stream: Path) -> None:
    folder = made(capture, tmp_path / "folder", "--sound", "cam03", "--sink", "segments", frames=4)
    made(capture, folder, "--sound", "cam03", "--resume")
    write_archive(FolderStore(folder), tmp_path / "archive.sgs")
    assert (tmp_path / "archive.sgs").read_bytes() == stream.read_bytes()
    more = ["--sink", "segments", "--preset", "compact", "--initial.iterations", "2", "--online.iterations", "1"]
    assert main([
        "reconstruct", str(capture), "-o", str(tmp_path / "both"), "--frames", "2", "--scale", "0.25",
        "--sound", "cam03", "--device", QUICKEST, "--qualities", "low=-1", "high=1", *more,
    ]) == 0  # fmt: skip
    heard = []
    for name in ("low", "high"):
        with open_stream(tmp_path / "both" / name) as reader:
            heard.append([reader.sound(index) for index in range(2)])
    assert heard[0] == heard[1]
    assert heard[0][1] is not None


@pytest.mark.parametrize(
    ("more", "status", "words"),
    [
        (["--sound", "cam99"], 1, "neither a camera nor a file cam99; the cameras with sound are cam03, cam04, cam05"),
        (["--sound", "cam00"], 1, "cam00.mp4 has no sound; choose another camera or file with --sound"),
        (["--sound", "cameras.json"], 1, "There is neither a camera nor a file cameras.json"),
        (["--sound", str(Path(CLIP) / "cameras.json")], 1, "cannot be opened"),
        (["--sound", "cam03", "--sound-offset", "1"], 1, "is in step by its clock, so it takes no --sound-offset"),
        (["--sound-offset", "1"], 2, "says when the file of --sound begins"),
    ],
)
def test_what_cannot_be_heard(
    capture: Path, tmp_path: Path, run: Runner, more: list[str], status: int, words: str
) -> None:
    arguments = ["reconstruct", str(capture), "-o", str(tmp_path / "x.sgs"), *QUARTER, *more]
    assert words in " ".join(run(arguments, status=status).err.split())
    assert not (tmp_path / "x.sgs").exists()


def in_video(path: Path) -> tuple[list[float], list[float]]:
    """When a video has claps, and when its pictures become white."""
    with av.open(str(path)) as container:
        parts = [(frame.time, np.abs(frame.to_ndarray()).max(0)) for frame in container.decode(audio=0)]
    heard = list[float]()
    for at in (seconds + place / 48_000 for seconds, part in parts for place in np.flatnonzero(part > LOUD)):
        if not heard or at - heard[-1] > APART_SECONDS:
            heard.append(at)
    with av.open(str(path)) as container:
        light = [(frame.time, float(frame.to_ndarray(format="gray").mean())) for frame in container.decode(video=0)]
    return heard, [at for (_, before), (at, now) in pairwise(light) if now > 100 >= before]


def test_a_rendered_video_has_the_clap_with_its_picture(tmp_path: Path, run: Runner) -> None:
    video = tmp_path / "v.mp4"
    render_it = ["render", str(SOUND_STREAM), "-o", str(video), "--device", QUICKEST]
    assert "no sound" not in run(render_it).err
    heard, seen = in_video(video)
    assert len(heard) == len(seen) == 1
    assert heard == pytest.approx(seen, abs=MOST_SECONDS / 4)
    error = run([*render_it, "--path", "orbit"]).err
    assert "The video has no sound, because it does not show the stream as it is." in error
    with av.open(str(video)) as container:
        assert not container.streams.audio


def test_a_rendered_video_is_in_step_after_ten_minutes(tmp_path: Path) -> None:
    """Frames of a second, again and again, with a recording of ten minutes; its pictures come in other distances."""
    seconds, fps = 600, 12
    at = [*np.arange(0.5, seconds)]
    sound = SoundFile("it", write_sound(tmp_path / "a.flac", claps(seconds, *at)), Clock())
    with open_stream(SOUND_STREAM) as second:
        packets = [[*second.group(index)][-1] for index in range(fps)]
        header = second.header
    sink = SoundSink(FileSink(tmp_path / "long.sgs"), sound, fps=fps, after=None)
    sink.open(header)
    shown = []
    for index in range(seconds * fps):
        if not 3000 <= index < 3600 and index % fps not in (0, 6):
            continue  # as a live stream leaves frames out
        one = packets[index % fps]
        payload = np.array([(len(shown), index / fps)], "<u4, <f8").tobytes() + one.payload[12:]
        kind = PacketKind.DELTA if shown else PacketKind.KEY
        sink.write(type(one)(kind, len(shown), index / fps, payload, one.field_bytes))
        shown.append(np.full((32, 48, 3), 255 if index % fps == 6 else 0, np.uint8))
    sink.close()
    with open_stream(tmp_path / "long.sgs") as reader:
        assert stream_heard(reader) == pytest.approx(at, abs=MILLISECOND)
        write_pictures(tmp_path / "long.mp4", shown, fps=fps, shown=reader)
        assert render.path_length(reader, None) == 7195  # from the first frame to the last, and a twelfth
    heard, seen = in_video(tmp_path / "long.mp4")
    assert len(heard) == seconds
    assert heard == pytest.approx(seen, abs=MOST_SECONDS / 4)
    assert max(abs(one - other) for one, other in zip(heard, at, strict=True)) < MOST_SECONDS / 4
