# SPDX-License-Identifier: Apache-2.0
"""EWA splatting in pure torch, differentiable by autograd, at any floating-point precision: the oracle.

Definition (as gsplat 1.5): perspective projection of the covariance with the point clamped to 1.3 times the field of
view, a low-pass of 0.3 square pixels (of the picture, or of the training pictures: :func:`screen_low_pass`), alpha =
opacity * exp(-power) used from 1/255 on and clamped at 0.999, front to back by camera depth until the transmittance
would fall to 1e-4, pixel centres at +0.5. A Gaussian behind a transmittance below 1/255 is drawn in that pixel, but
gets no gradient from it.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.cameras import Camera, Viewport
from structgstream.environment import in_environment
from structgstream.gaussians import Gaussians
from structgstream.geometry import quaternion_matrices
from structgstream.kernels.values import TILE_PIXELS, Rasterizer, RasterOutput, TileSelection

LOW_PASS_PIXELS = 0.3
"""Variance of the low-pass, square pixels."""
SCREEN_LOW_PASS_PIXELS = 0.15
"""Variance that a picture needs against aliasing, square pixels, if Gaussians have a low-pass of their own."""
MIN_ALPHA = 1.0 / 255.0
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4
MIN_GRADIENT_TRANSMITTANCE = 1.0 / 255.0
BOX_SLACK_PIXELS = 0.01


@dataclass(frozen=True)
class _Projected:
    means2d: Tensor  # [n, 2]
    conics: Tensor  # [n, 3]: xx, xy, yy
    opacities: Tensor  # [n] after the low-pass
    depths: Tensor  # [n]
    extents: Tensor  # [n, 2] half size of the box where alpha reaches 1/255
    rows: Tensor  # [n] index into the input


def _project(gaussians: Gaussians, viewport: Viewport, screen_offsets: Tensor | None) -> _Projected:
    means, quats, scales, opacities = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    viewmat, K, width, height = viewport.viewmat, viewport.K, viewport.width, viewport.height
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    columns = [means, quats, scales, opacities[:, None], gaussians.colors]
    if gaussians.sampling_intervals is not None:
        columns.append(gaussians.sampling_intervals[:, None])
    finite = torch.isfinite(torch.cat(columns, dim=1)).all(1)
    rows = ((points[:, 2] >= viewport.near) & (opacities >= MIN_ALPHA) & finite).nonzero()[:, 0]
    points = points[rows]
    x, y, z = points.unbind(1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.3 * 0.5 * width / fx, 0.3 * 0.5 * height / fy
    clamped_x = z * (x / z).clamp(-(cx / fx + margin_x), (width - cx) / fx + margin_x)
    clamped_y = z * (y / z).clamp(-(cy / fy + margin_y), (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * clamped_x / z**2, zero, fy / z, -fy * clamped_y / z**2], dim=1).reshape(
        -1, 2, 3
    )
    axes = jacobian @ viewmat[:3, :3] @ (quaternion_matrices(quats[rows]) * scales[rows][:, None])  # [n, 2, 3]
    covariances = axes @ axes.transpose(1, 2)
    xx, xy, yy = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    low_pass, opacities = LOW_PASS_PIXELS, opacities[rows]
    if gaussians.sampling_intervals is not None:
        trained, low_pass = screen_low_pass(gaussians.sampling_intervals[rows], z.detach(), K)
        # The determinant without low-pass is the square of a cross product, which does not cancel for needles.
        square = torch.linalg.cross(axes[:, 0].detach(), axes[:, 1].detach()).square().sum(1)
        size = (xx + yy).detach()
        before, after = (square + variance * (size + variance) for variance in (trained, low_pass))
        opacities = opacities * (before / after).sqrt()
    xx, yy = xx + low_pass, yy + low_pass
    determinant = xx * yy - xy * xy
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=1)
    if screen_offsets is not None:
        means2d = means2d + screen_offsets[rows]
    reach = 2.0 * torch.log(255.0 * opacities.detach()).clamp(min=0.0)
    extents = torch.stack([(reach * xx.detach()).sqrt(), (reach * yy.detach()).sqrt()], dim=1)
    conics = torch.stack([yy, -xy, xx], dim=1) / determinant[:, None]
    low, high = means2d.detach() - extents, means2d.detach() + extents
    size = means2d.new_tensor([width, height])
    seen = (
        (opacities >= MIN_ALPHA)
        & (determinant.detach() > 0)
        & (high > 0).all(1)
        & (low < size).all(1)
        & torch.isfinite(extents).all(1)
    )
    drawn = seen.nonzero()[:, 0]
    drawn = drawn[z.detach()[drawn].argsort(stable=True)]
    return _Projected(means2d[drawn], conics[drawn], opacities[drawn], z[drawn], extents[drawn], rows[drawn])


def screen_low_pass(intervals: Tensor, depths: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Variances ``[n]``, square pixels, of a Gaussian's low-pass on a picture: of the training pictures, and in total.

    The first does not change the opacity. The second is larger on pictures that are smaller than the training pictures,
    against aliasing. The addition preserves the Gaussian's light: the opacity is multiplied by the root of the ratio of
    the covariance's determinants before and after. Both count as constants in gradients.

    Args:
        intervals: ``[n]`` size of a training pixel at each Gaussian (``scene/sampling.py``, Note [Drawn as it was
            trained]).
        depths: ``[n]`` along the camera's axis.
        K: ``[3, 3]`` of the picture.
    """
    trained = LOW_PASS_PIXELS * K[0, 0] * K[1, 1] * (intervals / depths) ** 2
    return trained, trained.clamp(min=SCREEN_LOW_PASS_PIXELS)


def rasterize(
    gaussians: Gaussians,
    viewport: Viewport,
    *,
    background: Tensor | None = None,
    screen_offsets: Tensor | None = None,
    tiles: TileSelection | None = None,
    onto: Tensor | None = None,
    trained: int | None = None,
) -> RasterOutput:
    """Draw ``N`` Gaussians (paper, equations for mu_2D, Sigma_2D and alpha blending).

    A Gaussian behind a transmittance below 1/255 is drawn in that pixel, but gets no gradient from it. The low-pass is
    :func:`screen_low_pass`; it counts as a constant.

    Args:
        gaussians: to draw; their ids are not read.
        viewport: the camera.
        background: ``[3]``, black when None.
        screen_offsets: ``[N, 2]`` pixels, added to the projected means; its gradient is the view-space positional
            gradient.
        tiles: the tiles to draw, all when None. A Gaussian that reaches none of them has radius 0.
        onto: ``[H, W, 3]`` without gradient, contiguous, only with ``tiles``: the picture that is drawn into in place
            (Note [Ownership]); its other tiles do not change. None: the other tiles are zero.
        trained: only the first ``trained`` Gaussians get gradients; all when None.
    """
    gaussians, screen_offsets = detach_untrained(gaussians, screen_offsets, trained)
    projected = _project(gaussians, viewport, screen_offsets)
    radii = _radii(projected, len(gaussians))
    back = gaussians.means.new_zeros(3) if background is None else background
    low = projected.means2d.detach() - projected.extents
    high = projected.means2d.detach() + projected.extents
    if tiles is not None:
        radii[projected.rows[~boxes_reaching_tiles(low, high, tiles)]] = 0.0
    bands, bands_alpha = [], []
    for top in range(0, viewport.height, TILE_PIXELS):
        bottom = min(top + TILE_PIXELS, viewport.height)
        in_band = ((low[:, 1] < bottom) & (high[:, 1] > top)).nonzero()[:, 0]
        row, row_alpha = [], []
        for left in range(0, viewport.width, TILE_PIXELS):
            right = min(left + TILE_PIXELS, viewport.width)
            here = in_band[(low[in_band, 0] < right) & (high[in_band, 0] > left)]
            image, alpha = _tile(projected, here, gaussians, range(left, right), range(top, bottom))
            row.append(image + (1.0 - alpha)[..., None] * back)
            row_alpha.append(alpha)
        bands.append(torch.cat(row, dim=1))
        bands_alpha.append(torch.cat(row_alpha, dim=1))
    return restrict_to_tiles(torch.cat(bands), torch.cat(bands_alpha), radii, tiles, onto)


def projected_radii(gaussians: Gaussians, viewport: Viewport) -> Tensor:
    """The extents ``[N]`` of Gaussians on a picture, pixels, as :func:`rasterize` gives them; without graph.

    Args:
        gaussians: to project; their colours and ids are not read.
        viewport: the camera.
    """
    with torch.no_grad():
        return _radii(_project(gaussians, viewport, None), len(gaussians))


def _radii(projected: _Projected, count: int) -> Tensor:
    radii = projected.extents.new_zeros(count, dtype=torch.float32)
    radii[projected.rows] = projected.extents.amax(1).float() if len(projected.rows) else radii[:0]
    return radii


def detach_untrained(
    gaussians: Gaussians, screen_offsets: Tensor | None, trained: int | None
) -> tuple[Gaussians, Tensor | None]:
    """The arguments with rows from ``trained`` on detached."""
    if trained is None:
        return gaussians, screen_offsets
    values = {
        name: torch.cat([value[:trained], value[trained:].detach()]) for name, value in gaussians.columns().items()
    }
    if screen_offsets is not None:
        screen_offsets = torch.cat([screen_offsets[:trained], screen_offsets[trained:].detach()])
    return Gaussians(**values), screen_offsets


def restrict_to_tiles(
    image: Tensor, alpha: Tensor, radii: Tensor, tiles: TileSelection | None, onto: Tensor | None
) -> RasterOutput:
    """Restricts a full rendering to ``tiles``; other tiles are those of ``onto``, or zero."""
    if tiles is None:
        assert onto is None, "a picture to draw onto needs tiles"
        return RasterOutput(image, alpha, radii)
    inside = tiles.pixels()
    alpha = torch.where(inside, alpha, 0.0)
    if onto is None:
        return RasterOutput(torch.where(inside[..., None], image, 0.0), alpha, radii)
    onto = onto.detach()  # An alias, because autograd marks the tensor it is given as the function's result.
    return RasterOutput(onto.copy_(torch.where(inside[..., None], image, onto)), alpha, radii)


def blending_weights(gaussians: Gaussians, viewport: Viewport, maps: Tensor) -> Tensor:
    """Sums ``[N, C]`` over the pixels of each Gaussian's blending weight times each map, without graph.

    Weights are the gradients of :func:`rasterize` with respect to colour, which are zero behind a low transmittance.

    Args:
        gaussians: to draw; their colours and ids are not read.
        viewport: the camera.
        maps: ``[H, W, C]`` of the viewport's size, C at least 1.
    """
    return weights_by_gradient(rasterize, gaussians, viewport, maps)


def picture_and_weights(
    gaussians: Gaussians, viewport: Viewport, maps: Tensor, *, background: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The picture ``[H, W, 3]`` of :func:`rasterize` and the sums of :func:`blending_weights`, without graph.

    Args:
        gaussians: to draw; their ids are not read.
        viewport: the camera.
        maps: as for :func:`blending_weights`.
        background: ``[3]``, black when None.
    """
    with torch.no_grad():
        image = rasterize(gaussians, viewport, background=background).image
    return image, blending_weights(gaussians, viewport, maps)


def weights_by_gradient(rasterizer: Rasterizer, gaussians: Gaussians, viewport: Viewport, maps: Tensor) -> Tensor:
    """:func:`blending_weights` of any rasteriser.

    The gradient of a Gaussian's colour is the sum of its blending weights times the picture's gradient, which gives the
    sums of three maps per backward pass.
    """
    height, width, channels = maps.shape
    assert channels > 0, maps.shape
    assert (width, height) == (viewport.width, viewport.height), maps.shape
    found = []
    with torch.enable_grad():
        colors = torch.zeros_like(gaussians.means).requires_grad_()
        output = rasterizer(replace(gaussians, colors=colors), viewport)
        for first in range(0, channels, 3):
            group = maps[..., first : first + 3]
            cotangent = torch.nn.functional.pad(group, (0, 3 - group.shape[-1]))
            more = first + 3 < channels
            (sums,) = torch.autograd.grad(output.image, colors, cotangent, retain_graph=more)
            found.append(sums[:, : group.shape[-1]])
    return torch.cat(found, dim=1)


def as_picture(image: Tensor) -> Tensor:
    """A rendering ``[..., H, W, 3]`` in sRGB as the displayed 8-bit picture: clamped, then rounded."""
    # In place: a new tensor for each step takes six times as long.
    return image.detach().clamp(0.0, 1.0).mul_(255.0).round_().to(torch.uint8)


def display(image: Tensor, alpha: Tensor, camera: Camera, environment: Tensor | None) -> Tensor:
    """The displayed picture ``[H, W, 3]``, uint8.

    Args:
        image: ``[H, W, 3]`` drawn on black.
        alpha: ``[H, W]`` coverage.
        camera: whose picture it is.
        environment: ``[(degree + 1)^2, 3]`` coefficients of the background, of degree 2 at most (``environment.py``);
            None for black.
    """
    return as_picture(image if environment is None else in_environment(image, alpha, camera, environment))


def boxes_reaching_tiles(low: Tensor, high: Tensor, tiles: TileSelection) -> Tensor:
    """Mask ``[n]`` of the boxes (pixels) that contain a pixel centre of ``tiles``, or no pixel centre at all."""
    width, height = tiles.width, tiles.height
    first, last = (low - 0.5 - BOX_SLACK_PIXELS).ceil().long(), (high + 0.5 + BOX_SLACK_PIXELS).floor().long()
    x0, y0 = first[:, 0].clamp(0, width), first[:, 1].clamp(0, height)
    x1, y1 = last[:, 0].clamp(0, width), last[:, 1].clamp(0, height)
    covered = torch.zeros(height + 1, width + 1, dtype=torch.int64, device=low.device)
    covered[1:, 1:] = tiles.pixels().long().cumsum(0).cumsum(1)
    count = covered[y1, x1] - covered[y0, x1] - covered[y1, x0] + covered[y0, x0]
    return (count > 0) | (x0 >= x1) | (y0 >= y1)


def _tile(
    projected: _Projected, here: Tensor, gaussians: Gaussians, columns: range, rows: range
) -> tuple[Tensor, Tensor]:
    """Blend the Gaussians ``here``, ordered by depth, over one tile: ``[h, w, 3]`` and coverage ``[h, w]``.

    A Gaussian behind a transmittance below ``MIN_GRADIENT_TRANSMITTANCE`` gets no gradient from the pixel.
    """
    like, colors = projected.means2d, gaussians.colors
    if here.numel() == 0:
        return colors.new_zeros(len(rows), len(columns), 3), colors.new_zeros(len(rows), len(columns))
    xs = torch.arange(columns.start, columns.stop, dtype=like.dtype, device=like.device) + 0.5
    ys = torch.arange(rows.start, rows.stop, dtype=like.dtype, device=like.device) + 0.5
    dx = (xs[None, :] - like[here, 0, None])[:, None, :]  # [n, 1, w]
    dy = (ys[None, :] - like[here, 1, None])[:, :, None]  # [n, h, 1]
    xx, xy, yy = (projected.conics[here, i, None, None] for i in range(3))
    power = -0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy
    drawn = projected.rows[here]
    alpha = projected.opacities[here, None, None] * power.exp()
    alpha = torch.where(alpha >= MIN_ALPHA, alpha.clamp(max=MAX_ALPHA), 0.0)
    faint = _before((1.0 - alpha.detach()).cumprod(0)) <= MIN_GRADIENT_TRANSMITTANCE
    alpha = torch.where(faint, alpha.detach(), alpha)
    after = (1.0 - alpha).cumprod(0)
    # Transmittance decreases monotonically, so masking below the limit equals stopping there.
    blended = after.detach() > MIN_TRANSMITTANCE
    weights = torch.where(blended, alpha * _before(after), 0.0)
    lit = torch.einsum("nhw,nc->hwc", torch.where(faint, 0.0, weights), colors[drawn])
    rest = torch.einsum("nhw,nc->hwc", torch.where(faint, weights, 0.0), colors[drawn].detach())
    return lit + rest, weights.sum(0)


def _before(after: Tensor) -> Tensor:
    """Transmittance ``[n, h, w]`` in front of each Gaussian from that behind it."""
    return torch.cat([torch.ones_like(after[:1]), after[:-1]])
