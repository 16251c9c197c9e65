# SPDX-License-Identifier: Apache-2.0
import os
from pathlib import Path

import pytest

from structgstream.data.live.rig_file import LiveCamera, TimeBase, check_cameras, read_rig
from structgstream.errors import CaptureError

WHOLE = """
name = "studio"
calibration = "capture"
fps = 25
clock = "stream"
tolerance_seconds = 0.01
queue_frames = 16
end_seconds = 60
without = ["c"]

[cameras.a]
url = "http://user:secret@10.0.0.11/stream"
offset_seconds = -0.04
options = {reconnect = "1"}

[cameras.b]
url = "take/b.ts"
follow = true
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "rig.toml"
    path.write_text(text)
    return path


def test_what_ends_for_good_is_a_file(tmp_path: Path) -> None:
    """Whatever names it; streams and devices may come back."""
    (tmp_path / "a.ts").touch()
    os.mkfifo(tmp_path / "pipe")
    text = 'calibration = "."\n' + "".join(
        f"[cameras.{name}]\nurl = '{url}'\n{more}\n"
        for name, url, more in [
            ("path", "a.ts", ""),
            ("format", "a.ts", 'format = "mpegts"'),
            ("missing", "b.ts", ""),
            ("folder", ".", ""),
            ("url", f"file:{tmp_path}/a.ts", ""),
            ("url2", f"file://{tmp_path}/a.ts", ""),
            ("gone", f"file://{tmp_path}/b.ts", ""),
            ("growing", "a.ts", "follow = true"),
            ("awaited", "c.ts", 'format = "mpegts"\nfollow = true'),
            ("pipe", "pipe", ""),
            ("pipe2", "pipe", 'format = "mpegts"'),
            ("device", "/dev/null", ""),
            ("driver", "video=Camera", 'format = "dshow"'),
            ("network", "udp://10.0.0.1:5000", ""),
        ]
    )
    cameras = read_rig(written(tmp_path, text)).cameras
    assert [name for name, camera in cameras.items() if camera.is_file] == [
        "path", "format", "missing", "folder", "url", "url2", "gone"
    ]  # fmt: skip
    assert cameras["format"].url == str(tmp_path / "a.ts")
    assert cameras["awaited"].url == str(tmp_path / "c.ts")
    assert cameras["pipe2"].url == str(tmp_path / "pipe")
    assert cameras["driver"].url == "video=Camera"


def test_everything_that_a_file_can_say(tmp_path: Path) -> None:
    rig = read_rig(written(tmp_path, WHOLE))
    assert (rig.name, rig.fps, rig.clock, rig.queue_frames) == ("studio", 25.0, TimeBase.STREAM, 16)
    assert (rig.tolerance_seconds, rig.end_seconds, rig.without) == (0.01, 60.0, ("c",))
    assert rig.calibration == tmp_path / "capture"
    a, b = rig.cameras.values()
    assert (a.offset_seconds, a.options, a.is_file) == (-0.04, {"reconnect": "1"}, False)
    assert (b.url, b.follow, b.is_file) == (str(tmp_path / "take/b.ts"), True, False)


def test_a_description_of_a_session_is_beside_the_rig_file_and_no_recording(tmp_path: Path) -> None:
    text = WHOLE.replace("take/b.ts", "b.sdp").replace("follow = true", 'format = "sdp"')
    rig = read_rig(written(tmp_path, text.replace('clock = "stream"', 'clock = "arrival"')))
    camera = rig.cameras["b"]
    assert (camera.url, camera.is_session, camera.is_file) == (str(tmp_path / "b.sdp"), True, False)
    assert not LiveCamera("b.sdp").is_file
    assert not LiveCamera("http://studio/a.sdp").is_session


def test_little_is_needed(tmp_path: Path) -> None:
    rig = read_rig(written(tmp_path, 'calibration = "/calibrated"\n[cameras.a]\nurl = "/dev/video0"\nformat = "v4l2"'))
    assert (rig.name, rig.calibration, rig.clock) == ("rig", Path("/calibrated"), TimeBase.ARRIVAL)
    assert rig.cameras["a"].url == "/dev/video0"
    assert not rig.cameras["a"].is_file


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name = "studio"', "nmae = 1", "no key 'nmae'"),
        ('calibration = "capture"', "", "'calibration' is missing"),
        ("fps = 25", "fps = 0", "fps = 0.*more than 0"),
        ("fps = 25", 'fps = "25"', "fps = '25'"),
        ("fps = 25", "fps = nan", "fps = nan"),
        ('clock = "stream"', 'clock = "ntp"', "arrival, stream or unix"),
        ("http://user", "rtsp://user", 'clock = "stream", and camera \'a\' sends RTP.*take clock = "arrival"'),
        ("take/b.ts", "b.sdp", "camera 'b' sends RTP"),
        ("queue_frames = 16", "queue_frames = 1", "from 2 to 10000"),
        ("offset_seconds = -0.04", "offset = 1", "no key 'offset' in camera 'a'"),
        ('url = "take/b.ts"', "", "'url' is missing in camera 'b'"),
        ("follow = true", 'follow = "yes"', "true or false"),
        ('options = {reconnect = "1"}', "options = {timeout = 5}", "a table of texts"),
        ("[cameras.a]", "[camera.a]", "no key 'camera'"),
        ("[cameras.b]", "[cameras.a]", "cannot be read"),
        ("[cameras.b]", '[cameras.d]\nurl = "take/b.ts"\nfollow = true\n[cameras.b]', "'d' and 'b' of .* have one url"),
    ],
)
def test_what_is_wrong_is_said_in_a_sentence(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in WHOLE
    path = written(tmp_path, WHOLE.replace(old, new))
    with pytest.raises(CaptureError, match=said) as raised:
        read_rig(path)
    assert "\n" not in str(raised.value)
    assert "rig.toml" in str(raised.value)


def test_a_file_without_cameras_or_without_itself(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="has no cameras"):
        read_rig(written(tmp_path, 'calibration = "capture"'))
    with pytest.raises(CaptureError, match="cannot be read"):
        read_rig(tmp_path / "none.toml")


def test_cameras_are_those_of_the_calibration(tmp_path: Path) -> None:
    path = written(tmp_path, WHOLE)
    rig = read_rig(path)
    check_cameras(rig, ["a", "b", "c"], path)
    with pytest.raises(CaptureError, match="names camera 'c', which"):
        check_cameras(rig, ["a", "b"], path)
    with pytest.raises(CaptureError, match="lacks camera 'd'"):
        check_cameras(rig, ["a", "b", "c", "d"], path)
    both = read_rig(written(tmp_path, WHOLE.replace('["c"]', '["a"]')))
    with pytest.raises(CaptureError, match="under cameras and in without"):
        check_cameras(both, ["a", "b"], path)
