# SPDX-License-Identifier: Apache-2.0
"""L1 and SSIM in pure torch: the oracle of the loss.

SSIM (Wang et al., 2004) as 3D Gaussian splatting trains with it: 11 x 11 Gaussian window with sigma 1.5, zero padding,
C1 = 0.01^2, C2 = 0.03^2, mean over pixels and channels.
"""

import torch
from torch import Tensor

from structgstream.kernels.raster_types import TileSelection

WINDOW_PIXELS = 11
SIGMA_PIXELS = 1.5
C1 = 0.01**2
C2 = 0.03**2


def window(like: Tensor) -> Tensor:
    """The normalised 1D Gaussian window, ``[11]``."""
    positions = torch.arange(WINDOW_PIXELS, dtype=like.dtype, device=like.device) - WINDOW_PIXELS // 2
    weights = torch.exp(-(positions**2) / (2 * SIGMA_PIXELS**2))
    return weights / weights.sum()


def blurred(planes: Tensor) -> Tensor:
    """Separable Gaussian blur with zero padding, ``[P, H, W]``."""
    weights, half, count = window(planes), WINDOW_PIXELS // 2, planes.shape[0]
    rows = weights.reshape(1, 1, 1, -1).expand(count, 1, 1, -1)
    columns = weights.reshape(1, 1, -1, 1).expand(count, 1, -1, 1)
    across = torch.nn.functional.conv2d(planes[None], rows, padding=(0, half), groups=count)
    return torch.nn.functional.conv2d(across, columns, padding=(half, 0), groups=count)[0]


def in_unit_range(target: Tensor, like: Tensor) -> Tensor:
    """A uint8 picture as floats in [0, 1]; a float picture as it is."""
    return target.to(like) / 255.0 if target.dtype == torch.uint8 else target


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """SSIM at every pixel and channel, ``[H, W, 3]`` of two ``[H, W, 3]`` pictures in [0, 1]."""
    x, y = image.permute(2, 0, 1), target.permute(2, 0, 1)
    mean_x, mean_y, xx, yy, xy = blurred(torch.cat([x, y, x * x, y * y, x * y])).chunk(5)
    numerator = (2 * mean_x * mean_y + C1) * (2 * (xy - mean_x * mean_y) + C2)
    denominator = (mean_x**2 + mean_y**2 + C1) * (xx - mean_x**2 + yy - mean_y**2 + C2)
    return (numerator / denominator).permute(1, 2, 0)


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM of ``image`` ``[H, W, 3]`` against ``target`` ``[H, W, 3]``, float in [0, 1] or uint8."""
    return ssim_map(image, in_unit_range(target, image)).mean()


def l1_ssim(
    image: Tensor,
    target: Tensor,
    *,
    gains: Tensor | None = None,
    biases: Tensor | None = None,
    tiles: TileSelection | None = None,
) -> tuple[Tensor, Tensor]:
    """See ``kernels.operations.L1SSIM``."""
    if gains is not None:
        assert biases is not None
        image = image * gains.detach() + biases.detach()
    reference = in_unit_range(target, image)
    if tiles is None:
        return (image - reference).abs().mean(), ssim_map(image, reference).mean()
    inside = tiles.pixels()[..., None]
    image = torch.where(inside, image, image.detach())
    difference, similarity = (image - reference).abs(), ssim_map(image, reference)
    return (
        _valued(difference.mean(), difference.masked_fill(~inside, 0.0).mean()),
        _valued(similarity.mean(), similarity.masked_fill(~inside, 1.0).mean()),
    )


def _valued(graph: Tensor, value: Tensor) -> Tensor:
    """``value`` with the gradient of ``graph``."""
    return value.detach() + (graph - graph.detach())
