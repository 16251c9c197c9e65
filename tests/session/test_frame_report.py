# SPDX-License-Identifier: Apache-2.0
"""A frame's meter, and how many Gaussians of each kind a state has."""

from types import SimpleNamespace

import pytest
import torch

from structgstream.cameras import Camera
from structgstream.codec.packets import Packet, PacketKind
from structgstream.codec.scene_coder import Encoded
from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import Backend
from structgstream.session import frame_report
from structgstream.session.frame_report import counts, metered
from structgstream.training.result import FitResult
from tests.support.streams import small_scene

CPU = torch.device("cpu")


class Fixed:
    """Drawable, without anchors."""

    def gaussians(self, camera: Camera, backend: Backend) -> Gaussians:
        raise NotImplementedError

    def __len__(self) -> int:
        return 17


def test_a_scene_has_anchors_and_free_gaussians_and_others_are_free_altogether() -> None:
    assert counts(small_scene(4, free=2)) == {"anchors": 4, "free": 2}
    assert counts(Fixed()) == {"anchors": 0, "free": 17}


def test_each_second_belongs_to_one_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock moves by 1 while the frame is read, by 10 while it is fitted, and by 100 while it is written."""
    clock = SimpleNamespace(wall=0.0)
    monkeypatch.setattr(frame_report.time, "perf_counter", lambda: clock.wall)

    def frames():
        for number in range(2):
            clock.wall += 1.0
            yield number

    scene = small_scene(4, free=2)
    fit = FitResult(scene, iterations=3, train_psnr=30.0, moving=2, seconds={"backward": 4.0}, losses={"l1": 0.5})
    reports = []
    for meter, number in metered(frames(), CPU):
        clock.wall += 10.0
        meter.end("fit", peak="fit")
        clock.wall += 100.0
        meter.end("write", peak="store")
        packet = Packet(PacketKind.KEY, number, number / 30, b"", {})
        reports.append(meter.report(fit, Encoded(packet, scene), 9))
    assert [report.index for report in reports] == [0, 1]
    for report in reports:
        assert report.seconds == {"read": 1.0, "backward": 4.0, "fit": 10.0, "write": 100.0, "total": 111.0}
        assert report.losses == {"l1": 0.5}
        assert (report.bytes, report.moving, report.anchors, report.free) == (9, 2, 4, 2)
