# SPDX-License-Identifier: Apache-2.0
"""Numbers that the tools' own documents and public files print."""

import json
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.calibration_files import tools
from structgstream.data.calibration_files.opencv_cameras import OPENCV_CAMERAS
from structgstream.data.lenses import RadialTangential
from structgstream.errors import CalibrationError
from tests.support.calibrations import truths, write_kalibr, write_multical, write_opencv, write_qualisys, write_zju


def test_kalibrs_wiki(tmp_path: Path) -> None:
    """Its stereo example: the second camera stands 0.11 m to the right of the first."""
    (tmp_path / "camchain.yaml").write_text("""cam0:
  camera_model: pinhole
  intrinsics: [461.629, 460.152, 362.680, 246.049]
  distortion_model: radtan
  distortion_coeffs: [-0.27695497, 0.06712482, 0.00087538, 0.00011556]
  timeshift_cam_imu: -8.121e-05
  rostopic: /cam0/image_raw
  resolution: [752, 480]
cam1:
  camera_model: pinhole
  intrinsics: [461.629, 460.152, 362.680, 246.049]
  distortion_model: radtan
  distortion_coeffs: [-0.27695497, 0.06712482, 0.00087538, 0.00011556]
  T_cn_cnm1:
  - [0.99998854, 0.00216014, 0.00427195, -0.11003785]
  - [-0.00221074, 0.99992702, 0.01187697, 0.00045792]
  - [-0.00424598, -0.01188627, 0.99992034, -0.00064487]
  - [0.0, 0.0, 0.0, 1.0]
  resolution: [752, 480]
""")
    first, second = tools.KALIBR.read(next(tools.KALIBR.find(tmp_path))).cameras
    assert (first.name, first.size, first.K[0, 2]) == ("cam0", (752, 480), 363.18)
    assert first.lens == RadialTangential(-0.27695497, 0.06712482, 0.00087538, 0.00011556)
    assert second.center[0] == pytest.approx(0.11, abs=1e-3)
    text = (tmp_path / "camchain.yaml").read_text()
    for old, new in (("pinhole", "omni"), ("radtan", "fov")):
        (tmp_path / "camchain.yaml").write_text(text.replace(old, new))
        with pytest.raises(CalibrationError, match=rf"'cam0' of .*camchain\.yaml is of the model .*{new}"):
            tools.KALIBR.read(next(tools.KALIBR.find(tmp_path)))
    (tmp_path / "camchain.yaml").write_text("cam0: [\n")
    with pytest.raises(CalibrationError, match=r"camchain\.yaml cannot be read"):
        tools.KALIBR.read(next(tools.KALIBR.find(tmp_path)))


def test_a_long_chain_keeps_its_order(tmp_path: Path) -> None:
    """cam10 comes after cam9."""
    cameras = truths(names=[f"cam{number}" for number in range(12)], dist=(0, 0, 0, 0))
    found = tools.KALIBR.read((write_kalibr(tmp_path, cameras),)).cameras
    assert [camera.name for camera in found] == [camera.name for camera in cameras]
    expected = cameras[0].R @ (cameras[11].center - cameras[0].center)
    np.testing.assert_allclose(found[11].center, expected, atol=1e-9)


def test_multicals_format_page(tmp_path: Path) -> None:
    """``cam2_to_cam1`` with T = (-0.05, 0, 0): the second camera stands 0.05 to the right."""
    pose = {"R": np.eye(3).tolist(), "T": [-0.05, 0.0, 0.0]}
    camera = {"image_size": [2000.0, 1500.0], "K": [[2251.52, 0, 985.68], [0, 2252.8, 763.0], [0, 0, 1]]}
    camera["dist"] = [-0.12, 0.32, 0.0, 0.0, -0.2]
    first = {"R": np.eye(3).tolist(), "T": [0.0, 0.0, 0.0]}
    content = {"cameras": {"cam1": camera, "cam2": camera}, "camera_poses": {"cam1": first, "cam2_to_cam1": pose}}
    (tmp_path / "calibration.json").write_text(json.dumps(content))
    one, two = tools.MULTICAL.read(next(tools.MULTICAL.find(tmp_path))).cameras
    assert one.size == (2000, 1500)
    assert one.K[:2, 2].tolist() == pytest.approx([986.18, 763.5])
    np.testing.assert_allclose(two.center, [0.05, 0, 0])


def test_multical_without_a_master_and_in_a_chain(tmp_path: Path) -> None:
    """Absolute poses stay; a relative one may come before the one that it refers to."""
    cameras = truths()
    file = write_multical(tmp_path, cameras)
    content = json.loads(file.read_text())
    absolute = {camera.name: {"R": camera.R.tolist(), "T": camera.T.tolist()} for camera in cameras}
    file.write_text(json.dumps({**content, "camera_poses": absolute}))
    for truth, camera in zip(cameras, tools.MULTICAL.read((file,)).cameras, strict=True):
        np.testing.assert_allclose(camera.viewmat, truth.viewmat)
    step = cameras[2].viewmat @ np.linalg.inv(cameras[1].viewmat)
    chain = {"cam02_to_cam01": {"R": step[:3, :3].tolist(), "T": step[:3, 3].tolist()}}
    chain |= {name: absolute[name] for name in ("cam01", "cam00")}
    file.write_text(json.dumps({**content, "camera_poses": chain}))
    found = {camera.name: camera for camera in tools.MULTICAL.read((file,)).cameras}
    np.testing.assert_allclose(found["cam02"].viewmat, cameras[2].viewmat, atol=1e-12)
    file.write_text(json.dumps({**content, "camera_poses": {"a_to_b": absolute["cam00"]}}))
    with pytest.raises(CalibrationError, match="a_to_b refer to no camera that has one"):
        tools.MULTICAL.read((file,))


def test_qualisys_sensor_units(tmp_path: Path) -> None:
    """A Miqus of 1920x1088 pixels: 1/64 pixel on the sensor, distortion without a unit, millimetres."""
    text = """<calibration><cameras>
<camera active="1" serial="26580" model="Miqus Video" viewrotation="0">
<fov_video left="0" top="0" right="1919" bottom="1087"/>
<transform x="4263.3" y="2283.8" z="1794.3" r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1"/>
<intrinsic focallength="9.27" focalLengthU="107872.609375" focalLengthV="107880.257813" centerPointU="60827.273438"
 centerPointV="32684.021484" skew="0" radialDistortion1="-0.045450" radialDistortion2="0.139604"
 tangentalDistortion1="0.000615" tangentalDistortion2="-0.000391"/>
</camera></cameras></calibration>"""
    (tmp_path / "take.qca.txt").write_text(text)
    (camera,) = tools.QUALISYS.read(next(tools.QUALISYS.find(tmp_path))).cameras
    assert (camera.name, camera.size) == ("26580", (1920, 1088))
    assert camera.K[0, 0] == pytest.approx(1685.51, abs=0.01)
    assert camera.lens == RadialTangential(-0.04545, 0.139604, 0.000615, -0.000391)
    np.testing.assert_allclose(camera.center, [4.2633, 2.2838, 1.7943])
    (tmp_path / "take.qca.txt").write_text(text.replace('viewrotation="0"', 'viewrotation="90"'))
    with pytest.raises(CalibrationError, match=r"'26580' of .*turned by 90 degrees.*set the view rotation to 0"):
        tools.QUALISYS.read(next(tools.QUALISYS.find(tmp_path)))
    (tmp_path / "take.qca.txt").write_text(text.replace("<intrinsic ", "<optics "))
    with pytest.raises(CalibrationError, match="'26580' of .*no 'intrinsic'"):
        tools.QUALISYS.read(next(tools.QUALISYS.find(tmp_path)))
    (tmp_path / "take.qca.txt").write_text(text[:80])
    with pytest.raises(CalibrationError, match=r"take\.qca\.txt cannot be read"):
        tools.QUALISYS.read(next(tools.QUALISYS.find(tmp_path)))


@pytest.mark.parametrize("model", ["Miqus Video", "Miqus Hybrid", "none"])
def test_marker_cameras_of_qualisys_are_no_cameras(tmp_path: Path, model: str) -> None:
    file = write_qualisys(tmp_path, truths())
    file.write_text(file.read_text().replace("Miqus Video", model))
    found = tools.QUALISYS.read((file,))
    assert [camera.name for camera in found.cameras] == ["cam00", "cam01", "cam02"]


def test_zju_names_cameras_by_folder(tmp_path: Path) -> None:
    found = tools.ZJU_MOCAP.read((write_zju(tmp_path, truths(names=("Camera_B1", "Camera_B2", "Camera_B3"))),))
    assert [camera.name for camera in found.cameras] == [f"Camera_B{number}/000000.jpg" for number in (1, 2, 3)]
    np.save(tmp_path / "annots.npy", np.array({"cams": {}}, dtype=object))
    with pytest.raises(CalibrationError, match=r"annots\.npy cannot be read \(no 'ims'\); expected a dictionary"):
        tools.ZJU_MOCAP.read(next(tools.ZJU_MOCAP.find(tmp_path)))


def test_opencv_files_without_a_pose(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """What cv2.calibrateCamera's sample writes has intrinsics alone."""
    write_opencv(tmp_path, truths())
    file = tmp_path / "cam01.yml"
    file.write_text(file.read_text().replace("R: !!", "unknown: !!"))
    found = OPENCV_CAMERAS.read(next(OPENCV_CAMERAS.find(tmp_path)))
    assert [camera.name for camera in found.cameras] == ["cam00", "cam02"]
    assert found.unposed == ("cam01",)
    assert "has no pose of camera 'cam01'; left out" in caplog.text
    file.write_text("%YAML:1.0\n---\nK: !!opencv-matrix\n  rows: [\n")
    with pytest.raises(CalibrationError, match=r"Camera 'cam01' of .* cannot be read \(it is not YAML at line \d\)"):
        OPENCV_CAMERAS.read(next(OPENCV_CAMERAS.find(tmp_path)))
