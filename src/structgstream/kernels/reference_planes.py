# SPDX-License-Identifier: Apache-2.0
"""Correlation of a picture with its neighbours seen through planes, in pure torch: the oracle."""

from collections.abc import Sequence

import torch
from torch import Tensor

LEAST_DEPTH = 1e-6
UNSEEN = -1.0


def plane_scores(
    picture: Tensor, neighbours: Sequence[Tensor], homographies: Tensor, *, window: int, noise: float
) -> Tensor:
    """See ``kernels.operations.PlaneScores``, in the precision of ``picture``."""
    mean = _window_means(picture, window)
    variance = _window_means(picture * picture, window) - mean.square() + noise
    found = []
    for of_plane in homographies:
        scores = []
        for neighbour, homography in zip(neighbours, of_plane.to(picture), strict=True):
            warped, seen = _warped(neighbour.to(picture), homography, picture.shape)
            other_mean = _window_means(warped, window)
            covariance = _window_means(picture * warped, window) - mean * other_mean
            other_variance = _window_means(warped * warped, window) - other_mean.square() + noise
            score = covariance / (variance * other_variance).clamp(min=noise**2).sqrt()
            whole = _window_means(seen.to(picture), window) > 1.0 - 0.5 / window**2
            scores.append(torch.where(whole, score, UNSEEN))
        best = torch.stack(scores).topk(max(1, (len(scores) + 1) // 2), dim=0).values
        # A neighbour that does not see the plane counts half of the best one: a single match is more likely chance.
        found.append(torch.where(best == UNSEEN, best[0] / 2, best).mean(0))
    return torch.stack(found) if found else picture.new_empty(0, *picture.shape)


def _warped(picture: Tensor, homography: Tensor, size: torch.Size) -> tuple[Tensor, Tensor]:
    """Bilinear samples of ``picture`` at the places of pixels of a picture of ``size``, 0 where it does not see them;
    and the mask of those that it sees."""
    height, width = picture.shape
    rows, columns = (torch.arange(length).to(picture) for length in size)
    places = torch.stack([columns.expand(*size), rows[:, None].expand(*size), torch.ones(size).to(picture)], dim=-1)
    u, v, depth = (places @ homography.T).unbind(-1)
    x, y = u / depth, v / depth
    seen = (depth > LEAST_DEPTH) & (x >= 0.0) & (x <= width - 1) & (y >= 0.0) & (y <= height - 1)
    x, y = torch.where(seen, x, 0.0), torch.where(seen, y, 0.0)
    left, top = x.long().clamp(max=max(width - 2, 0)), y.long().clamp(max=max(height - 2, 0))
    right, bottom = (left + 1).clamp(max=width - 1), (top + 1).clamp(max=height - 1)
    fx, fy = x - left, y - top
    above = picture[top, left] + fx * (picture[top, right] - picture[top, left])
    below = picture[bottom, left] + fx * (picture[bottom, right] - picture[bottom, left])
    return torch.where(seen, above + fy * (below - above), 0.0), seen


def _window_means(image: Tensor, window: int) -> Tensor:
    """Means ``[H, W]`` over ``window`` x ``window`` pixels; the picture is mirrored beyond its edges."""
    for dim in (0, 1):
        length, reach = image.shape[dim], window // 2
        places = torch.arange(-reach, length + reach, device=image.device) % (2 * length)
        mirrored = image.index_select(dim, torch.minimum(places, 2 * length - 1 - places))
        image = torch.stack([mirrored.narrow(dim, n, length) for n in range(window)]).sum(0) / window
    return image
