# SPDX-License-Identifier: Apache-2.0
"""Projection matrices alone, ``[3, 4]``: they hold intrinsics, rotation and position, up to scale.

A text a camera with twelve numbers, after the word ``CONTOUR`` where PMVS reads it (``txt/00000000.txt``); or
``cameras*.npz`` with ``world_mat_0`` and so on, of IDR and NeuS. The top-left pixel's centre is (0, 0).
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from structgstream.data.calibration_files.reading import calibration_of, readable
from structgstream.data.lenses import from_integer_centers
from structgstream.data.posed import Calibration, PosedCamera, rigid
from structgstream.data.text_files import Unreadable, number, read_text

EXPECTED = "a projection matrix of 3x4 numbers, pixels of the pictures"
LARGEST_TEXT = 2000  # bytes of a file of twelve numbers
MIN_FOCAL_LENGTH = 10.0  # pixels; a pose without intrinsics has 1


def find(folder: Path) -> Iterator[tuple[Path, ...]]:
    """The files of IDR, one of which is enough, and texts of a camera each, of two cameras or more."""
    for file in sorted(folder.glob("cameras*.npz"))[-1:]:  # cameras_sphere.npz rather than cameras_large.npz
        yield (file,)
    for place in (folder, folder / "txt"):
        texts = tuple(file for file in sorted(place.glob("*.txt")) if _may_be_matrix(file))
        if len(texts) > 1:
            yield texts


def read(files: tuple[Path, ...]) -> Calibration:
    """A camera for each matrix.

    Raises:
        CalibrationError: one is broken.
    """
    if files[0].suffix == ".npz":
        with readable(files[0], "world_mat_0 and so on"), np.load(files[0], allow_pickle=False) as content:
            matrices = {key[10:]: content[key] for key in content if re.fullmatch(r"world_mat_\d+", key)}
        return calibration_of(matrices.items(), _camera, file=files[0], expected=EXPECTED)
    texts = ((file.stem, [number(word) for word in _words(file)]) for file in files)
    return calibration_of(texts, _camera, file=files[0].parent, expected=EXPECTED)


def _words(file: Path) -> list[str]:
    words = read_text(file).replace(";", " ").split()
    return words[words[:1] == ["CONTOUR"] :]


def _may_be_matrix(file: Path) -> bool:
    try:
        return file.stat().st_size < LARGEST_TEXT and np.isfinite([number(word) for word in _words(file)]).sum() == 12
    except (OSError, Unreadable):
        return False


def _camera(name: str, matrix: ArrayLike) -> PosedCamera:
    K, viewmat = decomposed(matrix)
    return PosedCamera(name, viewmat, from_integer_centers(K), None)


def decomposed(matrix: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Intrinsics ``[3, 3]`` and world to camera ``[4, 4]`` of ``[3, 4]`` numbers, or of the first rows of ``[4, 4]``
    (Hartley and Zisserman, section 6.2.4).

    Raises:
        Unreadable: it is of another shape, singular, or a pose without intrinsics.
    """
    P = np.ravel(np.array(matrix, np.float64))
    if P.size not in (12, 16) or not np.isfinite(P).all():
        raise Unreadable(f"a matrix of shape {np.shape(matrix)}, or with numbers that are not finite")
    P = P[:12].reshape(3, 4)
    determinant = float(np.linalg.det(P[:, :3] / max(np.abs(P[:, :3]).max(), 1e-300)))
    if abs(determinant) < 1e-15:
        raise Unreadable("a matrix of no camera: its first three columns have no inverse")
    P = P * np.sign(determinant)
    # The upper triangle comes first: a decomposition of rows from the last to the first (RQ by QR).
    q, r = np.linalg.qr(np.flipud(P[:, :3]).T)
    K, rotation = np.fliplr(np.flipud(r.T)), np.flipud(q.T)
    signs = np.sign(np.diag(K))
    K, rotation = K * signs, signs[:, None] * rotation
    viewmat = rigid(rotation, np.linalg.solve(K, P[:, 3]))
    K = K / K[2, 2]
    if min(K[0, 0], K[1, 1]) < MIN_FOCAL_LENGTH:
        raise Unreadable("a pose without intrinsics, in place of a projection matrix")
    return K, viewmat
