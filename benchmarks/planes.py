# SPDX-License-Identifier: Apache-2.0
"""Correlation of a picture with its neighbours through planes: this package's C++, its torch form, and OpenCV."""

from collections.abc import Callable

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmarks.benchmark import Benchmark, Variant
from benchmarks.contest import Contestant, Quantity, Results
from structgstream.kernels import cpu_motion, reference_motion

NEIGHBOURS, WINDOW, NOISE = 4, 5, 0.008**2
OUTSIDE = -1e6  # Far below any grey value, so that a sample that lies partly outside is detectable.


def task(width: int, planes: int) -> tuple[Tensor, list[Tensor], Tensor]:
    """A smooth picture, neighbours that show it shifted, and homographies that shift by up to a tenth of its width."""
    height = width * 9 // 16
    g = torch.Generator().manual_seed(1)
    noise = torch.rand(1, 1, height + 4, width + 4, generator=g)
    picture = torch.nn.functional.avg_pool2d(noise, 5, 1)[0, 0]
    neighbours = [picture.roll(3 * n + 2, 1) + 0.02 * torch.rand(height, width, generator=g) for n in range(NEIGHBOURS)]
    homographies = torch.eye(3, dtype=torch.float64).repeat(planes, NEIGHBOURS, 1, 1)
    homographies[..., 0, 2] = torch.linspace(0.3, width / 10, planes)[:, None] * torch.linspace(0.5, 1.0, NEIGHBOURS)
    return picture, neighbours, homographies


def opencv_scores(picture: Tensor, neighbours: list[Tensor], homographies: Tensor) -> Tensor:
    """The same scores by OpenCV's warps and box filters; it rounds places of samples to a 32nd of a pixel."""

    def means(image: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(image, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_REFLECT)

    own, others = picture.numpy(), [neighbour.numpy() for neighbour in neighbours]
    height, width = own.shape
    own_mean = means(own)
    own_variance = means(own * own) - own_mean**2 + NOISE
    found = np.empty((len(homographies), height, width), np.float32)
    for plane, of_plane in enumerate(homographies.numpy()):
        scores = []
        for other, homography in zip(others, of_plane, strict=True):
            flags, border = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_CONSTANT
            warped = cv2.warpPerspective(
                other, homography, (width, height), flags=flags, borderMode=border, borderValue=(OUTSIDE,)
            )
            seen = warped >= 0
            warped[~seen] = 0
            mean = means(warped)
            variance = means(warped * warped) - mean**2 + NOISE
            score = (means(own * warped) - own_mean * mean) / np.sqrt(np.maximum(own_variance * variance, NOISE**2))
            score[cv2.erode(seen.astype(np.uint8), np.ones((WINDOW, WINDOW), np.uint8)) == 0] = -1
            scores.append(score)
        best = np.sort(np.stack(scores), 0)[-2:]
        found[plane] = np.where(best == -1, best.max(0) / 2, best).mean(0)
    return torch.from_numpy(found)


def _with_one_opencv_thread(run: Callable[[], Tensor]) -> Callable[[], Results]:
    def alone() -> Results:
        before = cv2.getNumThreads()
        cv2.setNumThreads(1)
        try:
            return [run()]
        finally:
            cv2.setNumThreads(before)

    return alone


def contestants(*, width: int, planes: int) -> list[Contestant]:
    """OpenCV first, then the C++ and the oracle."""
    picture, neighbours, homographies = task(width, planes)

    def of(scores: Callable[..., Tensor]) -> Callable[[], Results]:
        return lambda: [scores(picture, neighbours, homographies, window=WINDOW, noise=NOISE)]

    return [
        Contestant("OpenCV", _with_one_opencv_thread(lambda: opencv_scores(picture, neighbours, homographies)), 1),
        Contestant("cpu", of(cpu_motion.plane_scores), 1),
        Contestant("torch reference", of(reference_motion.plane_scores), 1),
    ]


BENCHMARK = Benchmark(
    name="planes",
    work="one picture swept against four neighbours",
    contestants=contestants,
    # OpenCV rounds the places of samples to a 32nd of a pixel.
    quantities=[Quantity("scores", 1e-3, "norm")],
    variants=[
        Variant("240 x 135 pixels, 64 planes", {"width": 240, "planes": 64}, {"width": 48, "planes": 3}),
        Variant("96 x 54 pixels, 48 planes", {"width": 96, "planes": 48}, {"width": 32, "planes": 2}),
    ],
)
