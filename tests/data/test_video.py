# SPDX-License-Identifier: Apache-2.0
"""Videos as a capture, matched by time stamp, and their pictures, also where a file is damaged."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from structgstream.data.timeline import Clock
from structgstream.data.video import VideoSource, measured_fps, pictures_at, synchronised
from structgstream.data.video_index import VideoTrack, scan_videos
from structgstream.errors import CalibrationError, CaptureError, MissingExtraError
from tests.support.captures import (
    FULL,
    HEIGHT,
    LIMITED,
    WIDTH,
    Picture,
    all_numbers,
    numbers,
    picture,
    small_rig,
    write_video,
    write_videos,
)

RIG = small_rig(3)


def read(folder: Path, *, suffix: str = "mp4", **options: Any) -> VideoSource:
    tracks = scan_videos({name: folder / f"{name}.{suffix}" for name in RIG})
    return synchronised(tracks, RIG, where=folder, **options)


def rewrite(folder: Path, name: str, frames: list[int], instants: list[float] | None = None, fps: float = 30) -> None:
    """Another video for one camera: these frames at these times, both counted in frames."""
    camera = list(RIG).index(name)
    images = [picture(camera, frame) for frame in frames]
    write_video(folder / f"{name}.mp4", images, instants=instants or frames, fps=fps)


def test_frames_come_in_order_with_every_camera(tmp_path: Path) -> None:
    write_videos(tmp_path, list(RIG), frames=10)
    source = read(tmp_path)
    assert (len(source), source.fps, source.name) == (10, 30.0, tmp_path.name)
    frames = list(source.frames())
    assert all_numbers(frames) == [[(camera, frame) for camera in range(3)] for frame in range(10)]
    assert [frame.pts_seconds for frame in frames] == pytest.approx(np.arange(10) / 30)


@pytest.mark.parametrize(
    ("suffix", "options"),
    [
        *((suffix, {"qp": "10"}) for suffix in ("mp4", "mkv", "ts")),  # libx264 has no B-frames without loss
        ("mp4", {"x264-params": "intra-refresh=1:keyint=4"}),  # key frames that do not decode alone
    ],
)
def test_seeking_is_exact_for_every_start(tmp_path: Path, suffix: str, options: dict[str, str]) -> None:
    """Groups of 4 with B-frames, in containers with an index of their own and without one."""
    for camera, name in enumerate(RIG):
        images = [picture(camera, frame) for frame in range(12)]
        write_video(tmp_path / f"{name}.{suffix}", images, options=options)
    source = read(tmp_path, suffix=suffix)
    for start in range(12):
        assert all_numbers(source.frames(start)) == [[(n, frame) for n in range(3)] for frame in range(start, 12)]
    assert list(source.frames(12)) == []


def test_cameras_are_matched_by_time_not_by_count(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_videos(tmp_path, list(RIG), frames=8)
    rewrite(tmp_path, "cam01", [2, 3, 4, 5, 6, 7, 8])
    source = read(tmp_path)
    assert "'cam01' starts with the instant 0.067 s; 2 earlier" in caplog.text
    assert [[frame for _, frame in row] for row in all_numbers(source.frames())] == [[n] * 3 for n in range(2, 8)]


def test_a_missing_frame_is_an_absent_camera(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_videos(tmp_path, list(RIG), frames=8)
    rewrite(tmp_path, "cam01", [0, 1, 2, 3, 5, 7])
    source = read(tmp_path)
    assert "camera 'cam01' lacks 2 of 8 frames, the first of them the instant 0.133 s" in caplog.text
    for start in range(8):
        for frame in source.frames(start):
            present = ["cam00", "cam02"] if frame.index in (4, 6) else list(RIG)
            assert list(frame.images) == present
            assert all(numbers(image) == (list(RIG).index(name), frame.index) for name, image in frame.images.items())


def test_a_duplicate_frame_names_camera_and_time(tmp_path: Path) -> None:
    write_videos(tmp_path, list(RIG), frames=6)
    rewrite(tmp_path, "cam01", [0, 1, 2, 2, 3, 4, 5], [0, 1, 2, 2.25, 3, 4, 5])
    with pytest.raises(CaptureError, match=r"'cam01' .*two frames for the instant 0\.067 s"):
        read(tmp_path)


def test_a_duplicate_frame_with_clocks_leaves_the_nearer(tmp_path: Path) -> None:
    write_videos(tmp_path, list(RIG), frames=6)
    rewrite(tmp_path, "cam01", [0, 1, 2, 9, 3, 4, 5], [0, 1, 2, 2.25, 3, 4, 5])
    source = read(tmp_path, clocks={})
    assert [numbers(frame.images["cam01"])[1] for frame in source.frames()] == list(range(6))


def test_half_a_period_is_a_warning_and_no_frame_is_lost(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Jitter around half a period would put a frame here and there into the wrong slot, and leave others without."""
    write_videos(tmp_path, list(RIG), frames=8)
    late = [n + 0.96 + 0.04 * (n % 2) for n in range(8)]  # half a period from the middle of the three
    rewrite(tmp_path, "cam01", list(range(8)), late)
    source = read(tmp_path)
    assert all(len(frame.images) == 3 for frame in source.frames())
    rewrite(tmp_path, "cam01", list(range(8)), [n + 0.45 for n in range(8)])
    caplog.clear()
    source = read(tmp_path)
    assert "lie up to 15.0 ms from their instants (camera 'cam01')" in caplog.text
    np.testing.assert_allclose(source.apart_seconds["cam01"], 0.45 / 30, atol=1e-4)
    np.testing.assert_allclose(source.apart_seconds["cam02"], 0.0, atol=1e-4)
    assert [numbers(frame.images["cam01"])[1] for frame in source.frames()] == list(range(8))


def test_of_different_rates_the_lowest_is_taken(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_videos(tmp_path, list(RIG), frames=6)
    rewrite(tmp_path, "cam02", list(range(12)), fps=60)
    source = read(tmp_path)
    assert (source.fps, len(source)) == (30, 6)
    assert [numbers(frame.images["cam02"])[1] for frame in source.frames()] == [0, 2, 4, 6, 8, 10]
    caplog.clear()
    rewrite(tmp_path, "cam02", list(range(10)), fps=50)
    source = read(tmp_path)
    assert [numbers(frame.images["cam02"])[1] for frame in source.frames()] == [0, 2, 3, 5, 7, 8]
    assert "lie up to 6.7 ms from their instants (camera 'cam02'); what moves fast" in caplog.text


def test_clocks_move_and_stretch_the_time_stamps(tmp_path: Path) -> None:
    write_videos(tmp_path, list(RIG), frames=20)
    rewrite(tmp_path, "cam01", list(range(20)), [(n + 4.3) / 1.002 for n in range(20)])
    clocks = {"cam00": Clock(), "cam01": Clock(-7.3 / 30, 1.002), "cam02": Clock(0.004)}
    source = read(tmp_path, clocks=clocks)
    assert len(source) == 17
    assert source.apart_seconds["cam02"] - source.apart_seconds["cam00"] == pytest.approx(0.004, abs=1e-4)
    seen = [[numbers(image)[1] for image in frame.images.values()] for frame in source.frames()]
    assert seen == [[n, n + 3, n] for n in range(17)]


def test_the_rate_that_is_asked_for_thins_out(tmp_path: Path) -> None:
    write_videos(tmp_path, list(RIG), frames=9)
    source = read(tmp_path, fps=15, clocks={})
    assert [row[0][1] for row in all_numbers(source.frames())] == [0, 2, 4, 6, 8]


def test_a_rounded_rate_leaves_no_instant_without_pictures() -> None:
    stamps = tuple(round(frame * 1001 / 30000 * 90000) for frame in range(600))
    tracks = {name: VideoTrack(Path(f"{name}.mp4"), stamps, 1 / 90000, 64, 48) for name in RIG}
    source = synchronised(tracks, RIG, where=Path("capture"), fps=30)
    assert (len(source), source.fps) == (600, 30000 / 1001)
    assert all(None not in own for own in source.stamps.values())


def test_a_variable_rate_is_taken_by_time(tmp_path: Path) -> None:
    """A phone that leaves out frames and whose frames come a little early or late."""
    write_videos(tmp_path, list(RIG), frames=12)
    rng = np.random.default_rng(0)
    kept = [0, 1, 2, 3, 5, 6, 7, 9, 10, 11]
    rewrite(tmp_path, "cam02", kept, [n + float(rng.uniform(-0.2, 0.2)) * (n > 0) for n in kept])
    for frame in read(tmp_path).frames():
        assert ("cam02" in frame.images) == (frame.index in kept)
        if frame.index in kept:
            assert numbers(frame.images["cam02"]) == (2, frame.index)


@pytest.mark.parametrize("stamps", [(7, 7, 7), (0, 0, 1, 1, 2, 2)])
def test_frames_of_one_time_are_refused(stamps: tuple[int, ...]) -> None:
    """As some tools write them, and joining files byte by byte; the rate would be infinite."""
    track = VideoTrack(Path("cam00.mp4"), stamps, 1 / 30, 64, 48)
    with pytest.raises(CaptureError, match="frames of the video cam00.mp4 have the time stamp of the one before"):
        measured_fps({"cam00": track})


def test_rate_is_measured_from_the_time_stamps(tmp_path: Path) -> None:
    for name in RIG:
        rewrite(tmp_path, name, [0, 1, 2, 4, 5, 6, 7, 8, 9], fps=30000 / 1001)  # every camera misses a frame
    assert measured_fps(scan_videos({"a": tmp_path / "cam00.mp4"})) == pytest.approx(30000 / 1001, rel=1e-3)
    assert [len(frame.images) for frame in read(tmp_path).frames()] == [3, 3, 3, 0, 3, 3, 3, 3, 3, 3]
    rewrite(tmp_path, "cam00", [0, 1, 2, 3, 4], fps=17)
    assert measured_fps(scan_videos({"a": tmp_path / "cam00.mp4"})) == pytest.approx(17, rel=5e-3)


def test_a_video_of_another_size_than_its_intrinsics(tmp_path: Path) -> None:
    write_videos(tmp_path, list(RIG), frames=2)
    write_video(tmp_path / "cam01.mp4", [picture(1, frame, width=80, height=60) for frame in range(2)])
    with pytest.raises(CalibrationError, match=r"cam01\.mp4 has 80x60 pixels.*'cam01' are for 64x48"):
        read(tmp_path)


def test_missing_and_foreign_files_are_named(tmp_path: Path) -> None:
    write_videos(tmp_path, list(RIG), frames=2)
    (tmp_path / "cam02.mp4").write_bytes(b"no video at all" * 20)
    with pytest.raises(CaptureError, match=r"cam02\.mp4 cannot be opened"):
        read(tmp_path)
    (tmp_path / "cam02.mp4").unlink()
    with pytest.raises(CaptureError, match=r"cam02\.mp4 is missing"):
        read(tmp_path)


@pytest.mark.parametrize("kept", [0.3, 0.6, 0.9, 0.999])
def test_a_truncated_video_is_found_at_once(tmp_path: Path, kept: float) -> None:
    write_videos(tmp_path, list(RIG), frames=12)
    data = (tmp_path / "cam01.mp4").read_bytes()
    (tmp_path / "cam01.mp4").write_bytes(data[: int(kept * len(data))])
    with pytest.raises(CaptureError, match=r"cam01\.mp4 (is truncated|cannot be opened)"):
        read(tmp_path)


def noise(frames: int) -> list[Picture]:
    """Pictures of large files, so that damage hits data."""
    return [*np.random.default_rng(3).integers(0, 255, (frames, HEIGHT, WIDTH, 3), dtype=np.uint8)]


def damage(path: Path, share: float) -> None:
    """Zeros in place of what follows ``share`` of a file."""
    data = bytearray(path.read_bytes())
    middle = int(len(data) * share)
    for at in range(middle, min(middle + 4000, len(data))):
        if path.suffix != ".ts" or at % 188 >= 20:  # headers of transport packets stay
            data[at] = 0
    path.write_bytes(data)


def damaged(
    folder: Path, *, suffix: str = "mp4", share: float = 0.6, options: dict[str, str] | None = None
) -> VideoSource:
    """Videos of noise; that of ``cam01`` is broken from ``share`` of it on."""
    for name in RIG:
        write_video(folder / f"{name}.{suffix}", noise(24), options=options)
    damage(folder / f"cam01.{suffix}", share)
    return read(folder, suffix=suffix)


@pytest.mark.parametrize("share", [0.6, 0.95])
def test_a_damage_makes_its_camera_absent_up_to_the_next_key_frame(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, share: float
) -> None:
    source = damaged(tmp_path, share=share)
    present = ["cam01" in frame.images for frame in source.frames()]
    lost = [index for index, there in enumerate(present) if not there]
    assert 1 <= len(lost) <= 4  # within one group of 4
    assert lost == list(range(lost[0], lost[-1] + 1))
    (reported,) = [record.getMessage() for record in caplog.records if "decoded" in record.getMessage()]
    assert f"cam01.mp4 of camera 'cam01' cannot be decoded at {lost[0] / 30:.3f} s" in reported
    assert f"absent until {'the end' if share == 0.95 else f'{(lost[-1] + 1) / 30:.3f} s'}" in reported
    list(source.frames())
    assert sum("decoded" in record.getMessage() for record in caplog.records) == 1


def test_after_damage_a_transport_stream_with_b_frames_is_read_on(tmp_path: Path) -> None:
    """Seeking its key frames lands behind them."""
    options = {"crf": "20", "g": "8", "bf": "3", "x264-params": "scenecut=0:keyint=8:min-keyint=8"}
    source = damaged(tmp_path, suffix="ts", share=0.3, options=options)
    present = ["cam01" in frame.images for frame in source.frames()]
    assert not all(present)
    assert all(present[:4])
    assert all(present[-8:])


def test_a_broken_key_frame_costs_its_group_alone(tmp_path: Path) -> None:
    write_videos(tmp_path, list(RIG), frames=12)
    with av.open(str(tmp_path / "cam01.mp4")) as container:
        key = [packet for packet in container.demux(video=0) if packet.is_keyframe][1]
    data = bytearray((tmp_path / "cam01.mp4").read_bytes())
    assert key.pos is not None
    data[key.pos : key.pos + key.size] = bytes(key.size)
    (tmp_path / "cam01.mp4").write_bytes(data)
    source = read(tmp_path)
    for start in range(12):
        seen = ["cam01" in frame.images for frame in source.frames(start)]
        assert seen == [frame not in range(4, 8) for frame in range(start, 12)]


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.93])
@pytest.mark.parametrize("suffix", ["mp4", "mkv", "ts"])
def test_what_is_lost_does_not_depend_on_where_reading_starts(tmp_path: Path, suffix: str, share: float) -> None:
    """Else a resumed stream would see other pictures than the first run."""
    source = damaged(tmp_path, suffix=suffix, share=share)
    whole = list(source.frames())
    assert len(whole) == 24
    assert all({"cam00", "cam02"} <= set(frame.images) for frame in whole)
    for start in range(len(whole)):
        for frame in source.frames(start):
            assert list(frame.images) == list(whole[frame.index].images)
            for name, image in frame.images.items():
                np.testing.assert_array_equal(image, whole[frame.index].images[name])


@pytest.mark.parametrize("pixels", ["yuv420p", "yuv444p"])
@pytest.mark.parametrize("color_range", [LIMITED, FULL, None])
@pytest.mark.parametrize("matrix", [1, 5, None])
def test_colours_follow_the_matrix_and_range_of_the_file(
    tmp_path: Path, matrix: int | None, color_range: int | None, pixels: str
) -> None:
    """Without a statement: BT.601 at this size, limited range."""
    colors = np.array([(230, 40, 60), (20, 200, 90), (30, 60, 220), (250, 250, 250), (5, 5, 5), (240, 200, 30)])
    flat = [np.broadcast_to(color, (48, 64, 3)).astype(np.uint8) for color in colors]
    for name in RIG:
        write_video(tmp_path / f"{name}.mp4", flat, matrix=matrix, color_range=color_range, pixels=pixels)
    means = [frame.images["cam00"].mean(axis=(0, 1)) for frame in read(tmp_path).frames()]
    np.testing.assert_allclose(means, colors, atol=2.5)


def test_resized_videos_are_averaged(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    grey = np.repeat(rng.integers(0, 255, (48, 64, 1), dtype=np.uint8), 3, axis=2)
    for name in RIG:
        write_video(tmp_path / f"{name}.mp4", [grey, grey], color_range=FULL)
    half = RIG.mapped({name: RIG[name].resized(32, 24) for name in RIG})
    image = next(read(tmp_path).resized(half).frames()).images["cam00"]
    expected = grey.reshape(24, 2, 32, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(image, expected, atol=1.5)


def test_closing_releases_the_files(tmp_path: Path) -> None:
    write_videos(tmp_path, list(RIG), frames=6)

    def open_files() -> set[str]:
        links = (link for link in Path("/proc/self/fd").iterdir() if link.exists())
        return {str(link.readlink()) for link in links if str(link.readlink()).startswith(str(tmp_path))}

    frames = read(tmp_path).frames(1)
    next(frames)
    assert len(open_files()) == 3
    frames.close()  # type: ignore[attr-defined]
    assert not open_files()


def test_the_extra_is_named_when_the_reader_is_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"structgstream\[capture\]"):
        scan_videos({"a": tmp_path / "a.mp4"})


@pytest.fixture
def track(tmp_path: Path) -> VideoTrack:
    """Numbered pictures with B-frames, in groups of four."""
    write_video(tmp_path / "a.mp4", [picture(3, number) for number in range(16)])
    return scan_videos({"a": tmp_path / "a.mp4"})["a"]


def read_at(track: VideoTrack, stamps: list[int | None]) -> list[Picture | None]:
    """Pictures at time stamps, of which none is damaged."""

    def refuse(*reported: object) -> None:
        raise AssertionError(reported)

    shown = pictures_at(track, stamps, size=(WIDTH, HEIGHT), on_damage=refuse)
    return [None if one is None else one[0] for one in shown]


def test_any_ascending_choice_of_frames_is_exact(track: VideoTrack) -> None:
    for chosen in ([0, 1, 2], [5], [2, 7, 15], [11, 12]):
        found = read_at(track, [track.stamps[number] for number in chosen])
        assert [image is not None and numbers(image) for image in found] == [(3, number) for number in chosen]


def test_where_nothing_is_wanted_there_is_no_picture(track: VideoTrack) -> None:
    found = read_at(track, [None, track.stamps[4], None, track.stamps[6], None])
    assert [image is None for image in found] == [True, False, True, False, True]
    assert [numbers(image) for image in found if image is not None] == [(3, 4), (3, 6)]
    gone = replace(track, path=track.path.with_name("gone.mp4"))
    assert read_at(gone, [None, None]) == [None, None]  # not even opened


def test_a_video_whose_size_changes_is_refused_where_it_does(track: VideoTrack) -> None:
    larger = replace(track, width=2 * WIDTH, height=2 * HEIGHT)  # As its first frames may have had.
    with pytest.raises(CaptureError, match=r"changes its size from 128x96 to 64x48 at 0\.3"):
        read_at(larger, [track.stamps[9]])
