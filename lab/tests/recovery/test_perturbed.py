# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from lab.recovery.perturbed import main
from structgstream.data.calibration_files.tools import MULTICAL
from structgstream.data.dataset_layouts import bundled_clip, bundled_clip_path


def test_every_camera_of_the_file_is_as_far_off_as_asked(tmp_path: Path) -> None:
    file = tmp_path / "perturbed.json"
    main([str(bundled_clip_path()), str(file), "--degrees", "0.5", "--percent", "2"])
    truth, read = bundled_clip().rig, MULTICAL.read((file,)).cameras
    centers = np.stack([truth[name].center.numpy() for name in truth])
    radius = np.linalg.norm(centers - centers.mean(0), axis=1).max()
    assert {camera.name for camera in read} == set(truth)
    for camera in read:
        true = truth[camera.name]
        angle = np.degrees(np.arccos((np.trace(camera.viewmat[:3, :3] @ true.viewmat[:3, :3].numpy().T) - 1) / 2))
        moved = np.linalg.norm(camera.center - true.center.numpy()) / radius
        assert angle == pytest.approx(0.5, abs=1e-3)
        assert moved == pytest.approx(0.02, rel=1e-3)
        assert abs(camera.K[0, 0] / true.K[0, 0].item() - 1) == pytest.approx(0.02, rel=1e-3)
        assert camera.K[:2, 2] == pytest.approx(true.K[:2, 2].numpy())
