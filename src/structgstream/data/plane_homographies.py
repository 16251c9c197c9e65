# SPDX-License-Identifier: Apache-2.0
"""Homographies from a picture to its neighbours through planes (Hartley and Zisserman, Multiple View Geometry,
chapter 13)."""

from collections.abc import Sequence

import numpy as np

from structgstream.cameras import Camera
from structgstream.data.arrays import Floats


def plane_homographies(reference: Camera, cameras: Sequence[Camera], planes: Floats) -> Floats:
    """From pixel indices of ``reference`` to those of each of ``N`` cameras, through each plane: ``[P, N, 3, 3]``.

    Args:
        reference: the camera whose pixels are mapped.
        cameras: the others.
        planes: ``[P, 3]``; a plane is ``plane . x = 1`` in the axes of ``reference``.
    """
    # The first pixel has the index 0, its centre is at 0.5.
    centred = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    to_ray = np.linalg.inv(reference.K.numpy()) @ centred
    found = []
    for camera in cameras:
        relative = camera.viewmat.numpy() @ np.linalg.inv(reference.viewmat.numpy())
        to_pixel = np.linalg.inv(centred) @ camera.K.numpy()
        induced = relative[:3, :3] + relative[:3, 3:] * planes[:, None]
        found.append(to_pixel @ induced @ to_ray)
    return np.stack(found, axis=1)
