# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import av
import numpy as np
import pytest
import torch

from lab.rigs.containers import write_video
from lab.rigs.filming import Filming
from lab.rigs.light import Sensor
from lab.rigs.optics import filmed_camera
from lab.rigs.rig import base, poses
from lab.rigs.sound import SAMPLE_RATE, SPEED, Clap, Room
from lab.rigs.truth import TrueCamera, Truth, read_truth, write_truth
from structgstream.data.lenses import Fisheye, LensCamera

PICTURE = np.full((48, 64, 3), 90, np.uint8)


def test_stamps_survive_the_container(tmp_path: Path) -> None:
    stamps = [0.0, 0.0331, 0.1, 0.1337, 0.2]
    write_video(tmp_path / "a.mp4", [PICTURE] * 5, stamps, fps=30)
    with av.open(str(tmp_path / "a.mp4")) as container:
        found = [float(frame.time or 0.0) for frame in container.decode(video=0)]
    assert found == pytest.approx(stamps, abs=1e-5)


def test_pictures_survive_the_container(tmp_path: Path) -> None:
    ramp = np.tile(np.linspace(20, 230, 64).astype(np.uint8)[None, :, None], (48, 1, 3))
    write_video(tmp_path / "a.mp4", [ramp] * 3, [0, 1 / 30, 2 / 30], fps=30)
    with av.open(str(tmp_path / "a.mp4")) as container:
        found = np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])
    assert np.abs(found.astype(int) - ramp).mean() < 1.5


def test_sound_is_where_it_was_after_the_container(tmp_path: Path) -> None:
    sound = np.zeros(SAMPLE_RATE // 2)
    sound[12_000:12_200] = 0.8 * np.sin(np.arange(200))
    write_video(tmp_path / "a.mp4", [PICTURE] * 15, (np.arange(15) / 30).tolist(), fps=30, sound=sound)
    with av.open(str(tmp_path / "a.mp4")) as container:
        blocks = [(block.pts, block.to_ndarray()) for block in container.decode(audio=0)]
    first = blocks[0][0] or 0
    decoded = np.concatenate([values for _, values in blocks], 1)[0]
    loudest = int(np.argmax(np.abs(np.convolve(decoded**2, np.ones(200), mode="valid"))))
    assert first + loudest == pytest.approx(12_000, abs=48)  # a millisecond


def test_a_clap_arrives_with_the_delay_of_its_distance() -> None:
    room = Room((Clap(0.5, (0.0, 0.0, 0.0)),), noise=0.0)
    own = np.arange(SAMPLE_RATE) / SAMPLE_RATE
    arrivals = []
    for distance in (1.0, 2.0):
        heard = room.heard(np.array([distance, 0.0, 0.0]), own, offset=0.1, rate=1.0, gain=1.0, ear=0)
        hum = 0.002 * np.sin(2 * np.pi * 50 * (0.1 + own))
        arrivals.append(own[np.flatnonzero(np.abs(heard - hum) > 1e-6)[0]])
    assert arrivals == pytest.approx([0.4 + 1 / SPEED, 0.4 + 2 / SPEED], abs=2 / SAMPLE_RATE)


def test_a_stop_is_a_factor_of_two_in_linear_light() -> None:
    dim = np.full((4, 4, 3), 0.1, np.float32)
    up = Sensor(Filming(stops=1.0), seed=0).exposed(dim)
    np.testing.assert_allclose(up, Sensor(Filming(), seed=0).exposed(2 * dim), rtol=1e-6)
    sensor = Sensor(Filming(), seed=1, noise_levels=2.0)
    exposed = np.full((200, 200, 3), 100.0, np.float32)
    assert sensor.read(exposed, 0).std() == pytest.approx(2.0, rel=0.05)
    assert (sensor.read(exposed, 0) != sensor.read(exposed, 1)).any()
    assert (sensor.read(exposed, 3) == sensor.read(exposed, 3)).all()


def test_truth_is_read_as_it_was_written(tmp_path: Path) -> None:
    pose = poses()["cam02"]
    phone = filmed_camera(base(pose), Filming(lens="phone"))
    fish = LensCamera(phone.camera, Fisheye(-0.02, 0.002))
    truth = Truth(
        "try", "what", 30.0, 0.6, "cam00",
        {
            "cam00": TrueCamera(phone, 0.5, 1.001, 0.5, (1.1, 1.0, 0.9), (0.1, 0.2), 3.0, (0.4, pose @ pose)),
            "cam01": TrueCamera(fish),
        },
        claps=((1.5, (1.0, 2.0, 3.0)),), board={"columns": 7}, given=("cam01",),
    )  # fmt: skip
    write_truth(tmp_path, truth)
    found = read_truth(tmp_path)
    assert (found.claps, found.board, found.given, found.fps, found.held_out) == (
        truth.claps, truth.board, truth.given, truth.fps, truth.held_out,
    )  # fmt: skip
    for name, own in truth.cameras.items():
        again = found.cameras[name]
        assert again.filmed.lens == own.filmed.lens
        assert torch.equal(again.filmed.camera.viewmat, own.filmed.camera.viewmat)
        assert torch.equal(again.filmed.camera.K, own.filmed.camera.K)
        assert (again.offset_seconds, again.rate, again.dropped) == (own.offset_seconds, own.rate, own.dropped)
    assert found.cameras["cam00"].bumped is not None
    assert torch.equal(found.cameras["cam00"].bumped[1], pose @ pose)
