# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np

from lab.rigs.board import Drawing, before_an_arc, inside_a_ring
from lab.rigs.film import ring_poses
from lab.rigs.filming import Filming
from lab.rigs.light import Sensor
from lab.rigs.optics import filmed_camera
from lab.rigs.rig import TARGET, base, poses
from structgstream.preparation.calibration.board import Board

BOARD = Board()
GREY = np.full((480, 640, 3), 0.2, np.float32)


def test_opencv_finds_the_corners_where_the_truth_says() -> None:
    camera = filmed_camera(base(poses()["cam00"]), Filming(lens="phone"))
    towards = camera.camera.center.numpy()
    drawing, sensor = Drawing(BOARD, camera), Sensor(Filming(), seed=0)
    errors = []
    for pose in before_an_arc(BOARD, 12, target=np.array(TARGET), towards=towards, seed=1)[::3]:
        picture = sensor.read(sensor.exposed(drawing(GREY, pose)), 0)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(BOARD.opencv_board()).detectBoard(
            cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        )
        assert ids is not None
        world = BOARD.corners[np.asarray(ids, np.intp).ravel()] @ pose.rotation.T + pose.translation
        errors.append(corners.reshape(-1, 2) + 0.5 - camera.pixels(world))  # OpenCV's pixel centres are integers
    found = np.concatenate(errors)
    assert len(found) > 40
    assert np.abs(found.mean(0)).max() < 0.03
    assert np.median(np.abs(found)) < 0.1


def test_the_back_of_the_board_is_not_drawn() -> None:
    drawings = [Drawing(BOARD, filmed_camera(base(pose), Filming())) for pose in ring_poses().values()]
    seen = np.zeros(len(drawings), int)
    for pose in inside_a_ring(BOARD, 24, radius=2.0, height=1.3, seed=0):
        drawn = [bool((drawing(GREY, pose) != GREY).any()) for drawing in drawings]
        assert 2 <= sum(drawn) <= 5
        seen += drawn
    assert (seen >= 4).all()
