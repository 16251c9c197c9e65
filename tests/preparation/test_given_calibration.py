# SPDX-License-Identifier: Apache-2.0
"""Which of the calibrations that lie in a folder is taken; their formats have tests of their own."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.lenses import LensCamera, Pinhole, RadialTangential
from structgstream.data.prepared import PreparedCamera, PreparedCapture, write_prepared
from structgstream.data.undistortion import rectilinear
from structgstream.errors import CalibrationError
from structgstream.preparation.solvers import find_calibration, require_calibration
from tests.support.calibrations import WRITERS, truths, write_anipose, write_transforms
from tests.support.captures import small_rig, write_immersive, write_text_model

RIG = small_rig(3)


def write_cameras(folder: Path) -> Path:
    entries = {
        name: {"K": camera.K.tolist(), "viewmat": camera.viewmat.tolist()} for name, camera in RIG.cameras.items()
    }
    content = {"width": 64, "height": 48, "fps": 30, "frames": 1, "held_out": ["cam02"], "cameras": entries}
    (folder / "cameras.json").write_text(json.dumps(content))
    return folder / "cameras.json"


def write_capture(folder: Path) -> Path:
    filmed = {name: LensCamera(camera, RadialTangential(k1=-0.1)) for name, camera in RIG.cameras.items()}
    cameras = {name: PreparedCamera(f"{name}.mp4", own, rectilinear(own)) for name, own in filmed.items()}
    write_prepared(folder, PreparedCapture(cameras, 30.0, 0.1, "metres", frozenset({"cam01"})))
    return folder / "capture.json"


def write_colmap(folder: Path) -> Path:
    write_text_model(folder / "sparse" / "0", RIG, [(f"{name}.png", name) for name in RIG])
    return folder / "sparse" / "0" / "cameras.txt"


@pytest.mark.parametrize("by_file", [False, True])
def test_another_capture_gives_its_cameras_as_filmed(tmp_path: Path, by_file: bool) -> None:
    file = write_capture(tmp_path)
    found = require_calibration(file if by_file else tmp_path)
    assert [camera.name for camera in found.cameras] == list(RIG)
    assert list(found.held_out) == ["cam01"]
    for camera in found.cameras:
        assert camera.lens == RadialTangential(k1=-0.1)
        assert camera.size == (64, 48)
        np.testing.assert_allclose(camera.viewmat, RIG[camera.name].viewmat)
        np.testing.assert_allclose(camera.K, RIG[camera.name].K)


def test_a_file_of_cameras_is_of_pinholes(tmp_path: Path) -> None:
    found = require_calibration(write_cameras(tmp_path))
    assert list(found.held_out) == ["cam02"]
    assert {camera.lens for camera in found.cameras} == {Pinhole()}
    np.testing.assert_allclose(
        [camera.viewmat for camera in found.cameras], [own.viewmat for own in RIG.cameras.values()]
    )


def test_the_file_that_is_named_is_taken_and_of_a_folder_the_first(tmp_path: Path) -> None:
    """They lie beside each other, as tools leave them."""
    tool = truths(names=("a", "b", "c"))
    files = [write_capture(tmp_path), write_cameras(tmp_path), write_colmap(tmp_path)]
    files += [write_transforms(tmp_path, tool), write_anipose(tmp_path, tool)]
    named = [require_calibration(file).where for file in files]
    assert named == [*files[:2], files[2].parent, *files[3:]]
    for file, where in zip(files, named, strict=True):
        assert require_calibration(tmp_path).where == where
        shutil.rmtree(tmp_path / "sparse") if file == files[2] else file.unlink()
    assert find_calibration(tmp_path) is None


def test_models_of_fisheyes(tmp_path: Path) -> None:
    write_immersive(tmp_path, cameras=3, frames=1)
    assert len(require_calibration(tmp_path).cameras) == 3


def test_where_there_is_none(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("")
    write_cameras(tmp_path)
    assert find_calibration(tmp_path / "notes.txt") is None
    with pytest.raises(CalibrationError, match=r"notes\.txt is no calibration that is known"):
        require_calibration(tmp_path / "notes.txt")
    with pytest.raises(CalibrationError, match=r"nothing\.json does not exist"):
        require_calibration(tmp_path / "nothing.json")


@pytest.mark.parametrize("tool", ["anipose", "multical", "cmu_panoptic", "kalibr", "qualisys"])
def test_the_named_one_of_several_files_of_a_tool_is_taken(tool: str, tmp_path: Path) -> None:
    """Each of the files could be the one, and another one comes first in the folder."""
    files = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        file = WRITERS[tool](tmp_path / name, truths())
        files.append(file.rename(tmp_path / f"{name}-{file.name}"))
    for file in files:
        found = require_calibration(file)
        assert found.where == file
