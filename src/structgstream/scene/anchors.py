# SPDX-License-Identifier: Apache-2.0
"""Dynamic anchor points: the structured half of a scene (paper, section Structured 3DGs)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.cameras import Camera


@dataclass(frozen=True)
class AnchorCloud:
    """``M`` anchors, each of which carries ``K`` structured Gaussians.

    Args:
        positions: ``[M, 3]`` the paper's x_v, scene units.
        log_offset_scales: ``[M, 3]`` log of the paper's l_v, which multiplies the offsets. See Note [Two scales].
        log_base_scales: ``[M, 3]`` log of the largest scale that the covariance head may give.
        offsets: ``[M, K, 3]`` the paper's O_v, in units of l_v.
        features: ``[M, D]`` the paper's f_v.

    Note [Two scales]
    ~~~~~~~~~~~~~~~~~
    The paper's l_v has three numbers; Scaffold-GS, on which it builds, keeps six an anchor: three multiply offsets,
    three bound the Gaussians' scales. l_v is read as the first three (its only equation multiplies offsets by it); the
    others are ``log_base_scales``, static unless a configuration puts them in the dynamic set.
    """

    positions: Tensor
    log_offset_scales: Tensor
    log_base_scales: Tensor
    offsets: Tensor
    features: Tensor

    def __len__(self) -> int:
        return self.positions.shape[0]

    @property
    def offsets_per_anchor(self) -> int:
        """The paper's k."""
        return self.offsets.shape[1]


def visible_anchors(anchors: AnchorCloud, camera: Camera) -> Tensor:
    """Indices ``[m]`` int64, ascending, of the anchors that can put a Gaussian into the picture of ``camera``.

    Conservative: an anchor counts as a sphere that holds all its Gaussians at three standard deviations, so culling
    changes the cost of a rendering and never its pixels.
    """
    with torch.no_grad():
        viewmat = camera.viewmat.to(anchors.positions)
        points = anchors.positions @ viewmat[:3, :3].T + viewmat[:3, 3]  # [M, 3]
        reach = (anchors.offsets * anchors.log_offset_scales.exp()[:, None]).norm(dim=-1).amax(1)
        radius = reach + 3.4 * anchors.log_base_scales.amax(1).exp()  # [M]
        fx, fy, cx, cy = (float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        inside = points[:, 2] > camera.near - radius
        # Signed distance to each side plane of the frustum; the normals are unit length, so it compares with a radius.
        for normal in (
            (fx, 0.0, cx),
            (-fx, 0.0, camera.width - cx),
            (0.0, fy, cy),
            (0.0, -fy, camera.height - cy),
        ):
            plane = points.new_tensor(normal)
            inside &= points @ (plane / plane.norm()) > -radius * 1.1
        return inside.nonzero()[:, 0]
