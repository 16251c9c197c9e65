# SPDX-License-Identifier: Apache-2.0
"""The tool that sends as live cameras would, against what PyAV and the clock say."""

import io
import itertools
from pathlib import Path

import av
import pytest

from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.data.live.rig_file import read_rig
from tests.support.sender_modules import mpeg_ts, sender, sent_stream

WRAP = 2**33


def stamps(stream: bytes) -> list[int]:
    with av.open(io.BytesIO(stream), "r") as container:
        return [packet.pts for packet in container.demux(video=0) if packet.pts is not None]


@pytest.mark.parametrize("ticks", [0, 1, 90_000, 2**32 + 12_345, WRAP - 1])
def test_a_time_is_written_as_the_standard_says(ticks: int) -> None:
    first, second, third, fourth, fifth = mpeg_ts().presentation_time(ticks)
    assert first & 1 == third & 1 == fifth & 1 == 1
    high, middle, low = first >> 1 & 7, second << 7 | third >> 1, fourth << 7 | fifth >> 1
    assert high << 30 | middle << 15 | low == ticks


def test_stamps_are_when_pictures_were_filmed() -> None:
    begun = 1_700_000_000.0
    found = stamps(sent_stream(frames=24, begun=begun))
    assert [tick % WRAP for tick in found] == [round((begun + n / 30) * 90_000) % WRAP for n in range(24)]


@pytest.mark.parametrize(
    ("fault", "steps"),
    [("duplicate", {0, 3000}), ("reorder", {-3000, 3000, 6000, 9000, 0}), ("jump", {3000, 9_003_000, -8_997_000})],
)
def test_faults_are_in_the_stamps(fault: str, steps: set[int]) -> None:
    found = stamps(sent_stream(f"{fault}:0.2:0.2", frames=24))
    taken = {b - a for a, b in itertools.pairwise(found)}
    assert taken - {3000}
    assert taken <= steps


def test_cut_sends_nothing_and_goes_on_with_a_key_frame() -> None:
    found = [tick - 90_000_000 for tick in stamps(sent_stream("cut:0.2:0.2", frames=36))]
    numbers = [round(tick / 3000) for tick in found]
    assert numbers == [*range(6), *range(12, 36)]


def test_a_trouble_is_read_from_the_command_line() -> None:
    trouble = sender().Trouble.parsed("cam03:cut:20:10")
    assert (trouble.camera, trouble.fault, trouble.start, trouble.length) == ("cam03", "cut", 20.0, 10.0)
    with pytest.raises(ValueError, match="'nothing'"):
        sender().Trouble.parsed("cam03:nothing")


def test_its_rig_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(sender().rig_text({"cam00": "udp://127.0.0.1:5000"}, bundled_clip_path(), clock="unix", fps=10.0))
    rig = read_rig(path)
    assert (rig.clock, rig.fps, rig.calibration) == ("unix", 10.0, bundled_clip_path())
    assert rig.cameras["cam00"].format == "mpegts"


def test_pictures_are_sent_when_they_are_filmed() -> None:
    """Each is late by the jitter that was asked for, and no more than this machine adds."""
    module = sender()
    camera = module.SentCamera("a", {}, None, 30.0, [module.Trouble.parsed("a:jitter:1:1")])
    assert camera.delay(0) == 0.0
    assert 0.0 <= max(camera.delay(number) for number in range(30, 60)) <= 0.06
    assert max(camera.delay(number) for number in range(30, 60)) > 0.0
