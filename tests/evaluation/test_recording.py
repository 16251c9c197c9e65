# SPDX-License-Identifier: Apache-2.0
"""What is recorded is drawn on the device where it can be."""

import pytest
import torch

from structgstream.cameras import Camera
from structgstream.errors import BackendError
from structgstream.evaluation.recording import to_device
from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import Backend
from tests.support.streams import small_scene

CPU, ELSEWHERE = torch.device("cpu"), torch.device("meta")


class Fixed:
    """Drawable, and bound to the CPU."""

    def gaussians(self, camera: Camera, backend: Backend) -> Gaussians:
        raise NotImplementedError


class Roaming(Fixed):
    """As well on another device."""

    def on_device(self, device: torch.device) -> Fixed:
        self.device = device
        return self


def test_a_drawable_goes_to_a_device_if_it_can() -> None:
    scene, fixed, roaming = small_scene(), Fixed(), Roaming()
    found = to_device(scene, ELSEWHERE)
    assert found.anchors.positions.device == ELSEWHERE  # type: ignore[attr-defined]
    assert to_device(fixed, CPU) is fixed
    assert to_device(roaming, ELSEWHERE) is roaming
    assert roaming.device == ELSEWHERE
    with pytest.raises(BackendError, match="A Fixed cannot be drawn on meta; choose --device cpu"):
        to_device(fixed, ELSEWHERE)
