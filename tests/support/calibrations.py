# SPDX-License-Identifier: Apache-2.0
"""One made rig, written by hand in the format of every tool, and what OpenCV says of its pixels."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from structgstream.data.calibration import PosedCamera
from structgstream.geometry import Floats
from tests.support.captures import HEIGHT, WIDTH, small_rig

POINTS = np.random.default_rng(3).uniform(-0.6, 0.6, (30, 3))
NAMES = ("cam00", "cam01", "cam02")


@dataclass(frozen=True)
class Truth:
    """A camera as OpenCV has it: pixel centres at integers; ``fisheye`` says which of its models ``dist`` is of."""

    name: str
    K: Floats
    dist: tuple[float, ...]
    R: Floats
    T: Floats
    fisheye: bool = False

    @property
    def rvec(self) -> Floats:
        return np.asarray(cv2.Rodrigues(self.R)[0], np.float64).ravel()

    @property
    def center(self) -> Floats:
        return (-self.R.T @ self.T).astype(np.float64)

    @property
    def viewmat(self) -> Floats:
        """World to camera, ``[4, 4]``."""
        return np.vstack([np.column_stack([self.R, self.T]), [0, 0, 0, 1]])

    @property
    def opengl_pose(self) -> list[list[float]]:
        """Camera to world in OpenGL axes, rows of 4x4."""
        turned = np.column_stack([self.R.T @ np.diag([1, -1, -1]), self.center])
        return np.vstack([turned, [0, 0, 0, 1]]).tolist()

    def pixels(self, points: Floats) -> Floats:
        """What OpenCV projects, in the package's convention."""
        project = cv2.fisheye.projectPoints if self.fisheye else cv2.projectPoints
        found, _ = project(points[:, None], self.rvec, self.T, self.K, np.array(self.dist))
        return (found[:, 0] + 0.5).astype(np.float64)


def truths(*, names: Sequence[str] = NAMES, dist: tuple[float, ...] = (-0.1, 0.03, 0.002, -0.001, 0.01)) -> list[Truth]:
    """Cameras on an arc, of unequal focal lengths and off-centre principal points."""
    cameras = small_rig(len(names)).cameras.values()
    K = [[41.0, 0, WIDTH / 2 - 0.9], [0, 40.0, HEIGHT / 2 + 0.7], [0, 0, 1]]
    poses = [camera.viewmat.numpy() for camera in cameras]
    return [Truth(name, np.array(K), dist, pose[:3, :3], pose[:3, 3]) for name, pose in zip(names, poses)]


def pixels(camera: PosedCamera, points: Floats) -> Floats:
    """Where a camera that was read sees points."""
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    return camera.lens.distort(local[:, :2] / local[:, 2:]) @ camera.K[:2, :2].T + camera.K[:2, 2]


def write_anipose(folder: Path, cameras: Sequence[Truth]) -> Path:
    file = folder / "calibration.toml"
    tables = [
        f'[cam_{number}]\nname = "{camera.name}"\nsize = [ {WIDTH}, {HEIGHT},]\nmatrix = {camera.K.tolist()}\n'
        f"distortions = {list(camera.dist)}\nrotation = {camera.rvec.tolist()}\ntranslation = {camera.T.tolist()}\n"
        f"fisheye = {str(camera.fisheye).lower()}\n"
        for number, camera in enumerate(cameras)
    ]
    file.write_text("\n".join([*tables, "[metadata]\nadjusted = true\nerror = 0.4\n"]))
    return file


def opencv_matrix(key: str, value: Any) -> str:
    array = np.atleast_2d(np.asarray(value, float))
    data = ", ".join(repr(float(number)) for number in array.ravel())
    return f"{key}: !!opencv-matrix\n  rows: {array.shape[0]}\n  cols: {array.shape[1]}\n  dt: d\n  data: [{data}]\n"


def write_easymocap(folder: Path, cameras: Sequence[Truth]) -> Path:
    names = "names:\n" + "".join(f'  - "{camera.name}"\n' for camera in cameras)
    intri, extri = f"%YAML:1.0\r\n---\r\n{names}", f"%YAML:1.0\r\n---\r\n{names}"
    for camera in cameras:
        intri += opencv_matrix(f"K_{camera.name}", camera.K) + opencv_matrix(f"dist_{camera.name}", camera.dist)
        intri += f"H_{camera.name}: {HEIGHT}\nW_{camera.name}: {WIDTH}\n"
        extri += opencv_matrix(f"R_{camera.name}", camera.rvec[:, None]) + opencv_matrix(f"Rot_{camera.name}", camera.R)
        extri += opencv_matrix(f"T_{camera.name}", camera.T[:, None])
    (folder / "extri.yml").write_text(extri)
    (folder / "intri.yml").write_text(intri)
    return folder / "intri.yml"


def write_multical(folder: Path, cameras: Sequence[Truth]) -> Path:
    """Poses relative to the first camera, as multical has them with a master."""
    content: dict[str, Any] = {"cameras": {}, "camera_poses": {}}
    for camera in cameras:
        content["cameras"][camera.name] = {
            "model": "standard",
            "image_size": [WIDTH, HEIGHT],
            "K": camera.K.tolist(),
            "dist": [[value] for value in camera.dist] if camera.fisheye else [list(camera.dist)],
        }
        relative = camera.viewmat @ np.linalg.inv(cameras[0].viewmat)
        master = camera is cameras[0]
        key = camera.name if master else f"{camera.name}_to_{cameras[0].name}"
        content["camera_poses"][key] = {"R": relative[:3, :3].tolist(), "T": relative[:3, 3].tolist()}
    (folder / "calibration.json").write_text(json.dumps(content))
    return folder / "calibration.json"


def write_kalibr(folder: Path, cameras: Sequence[Truth]) -> Path:
    lines: list[str] = []
    for number, camera in enumerate(cameras):
        lines += [f"cam{number}:", "  cam_overlaps: []", "  camera_model: pinhole"]
        if number:
            chain = camera.viewmat @ np.linalg.inv(cameras[number - 1].viewmat)
            lines += ["  T_cn_cnm1:", *[f"  - {row}" for row in chain.tolist()]]
        K = camera.K
        lines += [
            f"  distortion_coeffs: {list(camera.dist[:4])}",
            f"  distortion_model: {'equidistant' if camera.fisheye else 'radtan'}",
            f"  intrinsics: {[K[0, 0].item(), K[1, 1].item(), K[0, 2].item(), K[1, 2].item()]}",
            f"  resolution: [{WIDTH}, {HEIGHT}]",
            f"  rostopic: /cam{number}/image_raw",
        ]
    (folder / "rig-camchain.yaml").write_text("\n".join(lines) + "\n")
    return folder / "rig-camchain.yaml"


def write_cmu(folder: Path, cameras: Sequence[Truth]) -> Path:
    """Centimetres; one of the many VGA cameras, which nobody has videos of, stands in it too."""
    entries = [
        {
            "name": camera.name,
            "type": "hd",
            "resolution": [WIDTH, HEIGHT],
            "panel": 0,
            "node": number,
            "K": camera.K.tolist(),
            "distCoef": list(camera.dist),
            "R": camera.R.tolist(),
            "t": (100 * camera.T[:, None]).tolist(),
        }
        for number, camera in enumerate(cameras)
    ]
    entries.append({**entries[0], "name": "01_01", "type": "vga"})
    (folder / "calibration_160906.json").write_text(json.dumps({"calibDataSource": "made", "cameras": entries}))
    return folder / "calibration_160906.json"


def write_opencv(folder: Path, cameras: Sequence[Truth]) -> Path:
    for camera in cameras:
        text = f"%YAML:1.0\n---\nimage_width: {WIDTH}\nimage_height: {HEIGHT}\n"
        text += opencv_matrix("camera_matrix", camera.K) + opencv_matrix("distortion_coefficients", camera.dist)
        text += f"fisheye_model: {int(camera.fisheye)}\n" + opencv_matrix("R", camera.R)
        (folder / f"{camera.name}.yml").write_text(text + opencv_matrix("T", camera.T[:, None]))
    return folder


def write_openpose(folder: Path, cameras: Sequence[Truth]) -> Path:
    def matrix(key: str, value: Any) -> str:
        array = np.asarray(value, float)
        data = " ".join(repr(float(number)) for number in array.ravel())
        rows, columns = array.shape
        head = f'<{key} type_id="opencv-matrix"><rows>{rows}</rows><cols>{columns}</cols><dt>d</dt>'
        return f"{head}<data>{data}</data></{key}>"

    for camera in cameras:
        dist = np.zeros((8, 1))
        dist[: len(camera.dist), 0] = camera.dist
        body = matrix("CameraMatrix", camera.viewmat[:3]) + matrix("Intrinsics", camera.K) + matrix("Distortion", dist)
        text = f'<?xml version="1.0"?>\n<opencv_storage>\n{body}\n</opencv_storage>\n'
        (folder / f"{camera.name}.xml").write_text(text)
    return folder


def write_qualisys(folder: Path, cameras: Sequence[Truth]) -> Path:
    """Millimetres, axes y up and z backward, 1/64 pixel from the sensor's border; a marker camera stands in it too."""
    tags = ['<camera serial="1" model="Miqus M3" viewrotation="0"/>']
    left, top = 8, 4
    for camera in cameras:
        rotation = np.diag([1, -1, -1]) @ camera.R
        turns = " ".join(f'r{i + 1}{j + 1}="{rotation[i, j].item()!r}"' for i in range(3) for j in range(3))
        x, y, z = (1000 * camera.center).tolist()
        k1, k2, p1, p2, k3 = camera.dist
        K = camera.K
        cu, cv = 64 * (K[0, 2].item() + 0.5 + left), 64 * (K[1, 2].item() + 0.5 + top)
        tags.append(
            f'<camera active="1" serial="{camera.name}" model="Miqus Video" viewrotation="0">'
            f'<fov_video left="{left}" top="{top}" right="{left + WIDTH - 1}" bottom="{top + HEIGHT - 1}"/>'
            f'<transform x="{x!r}" y="{y!r}" z="{z!r}" {turns}/>'
            f'<intrinsic focallength="9.2" sensorMinU="0" sensorMaxU="6000" focalLengthU="{64 * K[0, 0].item()!r}" '
            f'focalLengthV="{64 * K[1, 1].item()!r}" centerPointU="{cu!r}" centerPointV="{cv!r}" skew="0" '
            f'radialDistortion1="{k1}" radialDistortion2="{k2}" radialDistortion3="{k3}" '
            f'tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"/></camera>'
        )
    head = '<?xml version="1.0" encoding="UTF-8"?><calibration created="2019"><cameras>'
    (folder / "Calib.qca.txt").write_text(f"{head}{''.join(tags)}</cameras></calibration>")
    return folder / "Calib.qca.txt"


def write_zju(folder: Path, cameras: Sequence[Truth]) -> Path:
    """Millimetres, pickled, by instants and cameras."""
    cams = {
        "K": [camera.K for camera in cameras],
        "D": [np.array(camera.dist)[:, None] for camera in cameras],
        "R": [camera.R for camera in cameras],
        "T": [1000 * camera.T[:, None] for camera in cameras],
    }
    ims = [{"ims": [f"{camera.name}/{frame:06d}.jpg" for camera in cameras]} for frame in range(2)]
    np.save(folder / "annots.npy", np.array({"cams": cams, "ims": ims}, dtype=object))
    return folder / "annots.npy"


def write_transforms(folder: Path, cameras: Sequence[Truth], *, pattern: str = "images/NAME/000000.png") -> Path:
    """OpenGL axes, camera to world, the top-left pixel's centre at (0.5, 0.5)."""
    frames = []
    for camera in cameras:
        file = pattern.replace("NAME", camera.name)
        frames.append({"file_path": file, "transform_matrix": camera.opengl_pose})
    camera = cameras[0]
    keys = ("k1", "k2", "k3", "k4") if camera.fisheye else ("k1", "k2", "p1", "p2", "k3")
    content = {
        "camera_model": "OPENCV_FISHEYE" if camera.fisheye else "OPENCV",
        "w": WIDTH,
        "h": HEIGHT,
        "fl_x": camera.K[0, 0],
        "fl_y": camera.K[1, 1],
        "cx": camera.K[0, 2] + 0.5,
        "cy": camera.K[1, 2] + 0.5,
        **dict(zip(keys, camera.dist)),
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder / "transforms.json"


def write_projections(folder: Path, cameras: Sequence[Truth]) -> Path:
    """As PMVS has them: K [R | t] alone, up to scale, so without lens and size."""
    for camera in cameras:
        matrix = -3.0 * camera.K @ camera.viewmat[:3]
        rows = "\n".join(" ".join(map(repr, row)) for row in matrix.tolist())
        (folder / f"{camera.name}.txt").write_text(f"CONTOUR\n{rows}\n")
    return folder / f"{cameras[0].name}.txt"


WRITERS: dict[str, Callable[[Path, Sequence[Truth]], Path]] = {
    "anipose": write_anipose,
    "easymocap": write_easymocap,
    "multical": write_multical,
    "kalibr": write_kalibr,
    "cmu_panoptic": write_cmu,
    "qualisys": write_qualisys,
    "zju_mocap": write_zju,
    "opencv_cameras": write_opencv,
    "openpose": write_openpose,
    "transforms": write_transforms,
}
OF_PINHOLES = {"projections": write_projections}
"""Of tools that know no lens."""
