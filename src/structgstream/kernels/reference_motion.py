# SPDX-License-Identifier: Apache-2.0
"""Changes and motion between pictures, in pure torch: the oracles."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, grid_sample, interpolate, max_pool2d

from structgstream.kernels.values import Lifted, Neighbors, SweepView, Swept, TileSelection, ViewFlows, tile_pixels


def changed_pixels(before: Tensor, now: Tensor, *, threshold: float, reach_pixels: int) -> Tensor:
    """Dilated masks ``[..., H, W]`` of the pixels that changed between two pictures ``[..., H, W, 3]`` uint8.

    A pixel has changed when the mean absolute difference over its 3 x 3 neighbourhood (inside the picture) and the
    channels exceeds ``threshold``. Sums are of integers, so every back-end gives the same mask.

    Args:
        before: each camera's earlier picture.
        now: its later picture.
        threshold: in 0 ... 1, above the sensor's noise.
        reach_pixels: half width of the square by which the mask is dilated, pixels.
    """
    difference = (before.to(torch.int32) - now.to(torch.int32)).abs().sum(-1).float()  # exact
    difference = difference.reshape(-1, 1, *now.shape[-3:-1])
    ones = torch.ones(1, 1, 3, 3, device=difference.device)
    sums = conv2d(difference, ones, padding=1)
    counts = conv2d(torch.ones_like(difference[:1]), ones, padding=1)
    limit = torch.tensor(threshold, dtype=torch.float32) * (255 * 3 * counts)
    marks = (sums > limit).float()
    size = 2 * reach_pixels + 1
    return (max_pool2d(marks, size, stride=1, padding=reach_pixels) > 0).reshape(now.shape[:-1])


def picture_residuals(
    renderings: Sequence[Tensor],
    pictures: Tensor,
    *,
    gains: Tensor | None = None,
    biases: Tensor | None = None,
    tiles: Sequence[TileSelection] | None = None,
    outside: Sequence[Tensor] | None = None,
    masks: Tensor | None = None,
) -> Tensor:
    """Mean absolute difference ``[V, h, w]`` of renderings to pictures of ``V`` cameras, in 0 ... 1; without graph.

    The mean is over channels and the 3 x 3 neighbourhood inside the picture. A rendering is compared as its camera
    would have recorded it: ``gains * rendering + biases``, clamped to 0 ... 1 and averaged down to the picture's size.

    Args:
        renderings: ``V`` of ``[H, W, 3]``.
        pictures: ``[V, h, w, 3]`` uint8, not larger than the renderings.
        gains: ``[V, 3]``; one when None.
        biases: ``[V, 3]``; given with ``gains``.
        tiles: ``outside`` replaces a rendering outside these tiles.
        outside: ``V`` of ``[H, W, 3]`` uint8; given with ``tiles``.
        masks: ``[V, h, w]`` bool; pixels where it is False do not differ.
    """
    recorded = torch.stack(list(renderings))
    if gains is not None and biases is not None:
        recorded = recorded * gains[:, None, None] + biases[:, None, None]
    recorded = recorded.clamp(0.0, 1.0)
    if tiles is not None and outside is not None:
        recorded = torch.where(tile_pixels(tiles)[..., None], recorded, torch.stack(list(outside)).to(recorded) / 255.0)
    reduced = interpolate(recorded.permute(0, 3, 1, 2), size=pictures.shape[1:3], mode="area").permute(0, 2, 3, 1)
    off = (reduced - pictures.to(reduced) / 255.0).abs().mean(-1)
    off = off if masks is None else torch.where(masks, off, 0.0)
    found = avg_pool2d(off[:, None], 3, stride=1, padding=1, count_include_pad=False)[:, 0]
    return found if masks is None else torch.where(masks, found, 0.0)


def confident_flow(flow: Tensor, back: Tensor, mask: Tensor | None, *, relative: float, absolute: float) -> Tensor:
    """Maps ``[3, H, W]`` of c, c flow_x and c flow_y, where c is 1 if flow there and back agree (forward-backward
    consistency, Sundaram et al., 2010), else 0.

    With ``f`` the flow and ``b`` the flow back: ``|f(p) + b(p + f(p))|^2 <= relative (|f(p)|^2 + |b(p + f(p))|^2) +
    absolute``, and ``p + f(p)`` lies inside the outermost pixel centres. Tensors are on the CPU, as estimated flow is.

    Args:
        flow: ``[H, W, 2]`` float32, pixels.
        back: ``[H, W, 2]`` float32, from the second picture to the first.
        mask: ``[H, W]`` bool, c is 0 elsewhere; None for all pixels.
        relative: share of the squared lengths.
        absolute: squared pixels.
    """
    height, width = flow.shape[:2]
    x = flow[..., 0] + torch.arange(width)
    y = flow[..., 1] + torch.arange(height)[:, None]
    grid = torch.stack([x * (2 / max(width - 1, 1)) - 1, y * (2 / max(height - 1, 1)) - 1], dim=-1)
    planes = back.permute(2, 0, 1)[None]
    returned = grid_sample(planes, grid[None], mode="bilinear", padding_mode="border", align_corners=True)[0]
    there = flow.permute(2, 0, 1)
    rest = (there + returned).square().sum(0)
    lengths = there.square().sum(0) + returned.square().sum(0)
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    agree = (rest <= relative * lengths + absolute) & inside
    agree = agree if mask is None else agree & mask
    return torch.where(agree, torch.cat([torch.ones(1, height, width), there]), 0.0)


MIN_TOLERANCE, TOLERANCE_SHARE = 1.0, 0.1
"""Tolerance of an observed flow f: the first plus the second times |f|, in the unit of f.

The unit is the error of small flow (``training/online/scene_flow.py``). The second covers errors that grow with the
displacement: the linearised projection, rotation of the object (one displacement fits several neighbours), and errors
of the search on large motion, together 5 to 10 per cent of |f|."""
ROBUST_SCALES = (4.0, 2.5, 1.5, 1.5, 1.0, 1.0)
"""Scale of the Geman-McClure weights in each round after the first, which has none, in tolerances."""
INLIER_SCALE = 1.5
"""A flow whose residual is below this, in tolerances, is an inlier."""
PRIOR_SHARE, PRIOR_FLOOR = 0.02, 0.05


def projection_jacobians(centers: Tensor, viewmats: Tensor, Ks: Tensor, near: Tensor) -> Tensor:
    """Jacobians ``[V, E, 2, 3]`` of each point's projection, pixels per unit; zero in front of the near plane."""
    points = torch.einsum("vij,ej->vei", viewmats[:, :3, :3], centers) + viewmats[:, None, :3, 3]
    x, y, z = points.unbind(-1)
    front = z > near[:, None]
    z = torch.where(front, z, 1.0)
    zero = torch.zeros_like(z)
    fx, fy = Ks[:, 0, 0, None], Ks[:, 1, 1, None]
    local = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], -1).unflatten(-1, (2, 3))
    return (local @ viewmats[:, None, :3, :3]) * front[..., None, None]


def lift(centers: Tensor, seen: ViewFlows, neighbors: Neighbors, priors: Tensor, *, share: float) -> Lifted:
    """For each of ``T`` targets the 3D displacement d that fits its neighbours' optical flow in all views.

    Minimises ``sum g W rho(J d - f) + reg |d - prior|^2`` over neighbours and views by iteratively reweighted least
    squares: one round without robust weights, then Geman-McClure weights ``1 / (1 + r^2 / (s tau)^2)^2`` of decreasing
    scale s (``ROBUST_SCALES``), with the residual ``r = |J d - f|`` and the tolerance ``tau = 1 +
    0.1 |f|``. A flow with ``r < 1.5 tau`` in the end is an inlier. ``reg`` is ``0.02 sum + 0.05`` times the mean
    square of J, with the sum of the present weights.

    Args:
        centers: ``[E, 3]`` centres of the dynamic anchors and Gaussians.
        seen: their W and f in each view.
        neighbors: neighbours of each target, and g.
        priors: ``[T, 3]`` expected displacements.
        share: as in :class:`Lifted`.
    """
    jacobians = projection_jacobians(centers, seen.viewmats, seen.Ks, seen.near)
    usable = seen.weights * (jacobians.abs().sum((-1, -2)) > 0)
    w = neighbors.affinities[None] * usable[:, neighbors.rows]  # [V, T, N]
    J, f = jacobians[:, neighbors.rows], seen.flows[:, neighbors.rows]
    total = w.sum((0, 2))
    stiffness = (w * J.square().sum((-1, -2))).sum((0, 2)) / (2.0 * total.clamp(min=1e-12))
    eye = torch.eye(3, dtype=centers.dtype, device=centers.device)
    tolerances = MIN_TOLERANCE + TOLERANCE_SHARE * f.norm(dim=-1)  # [V, T, N]
    d = priors
    for scale in (None, *ROBUST_SCALES):
        now = w
        if scale is not None:
            now = w / (1.0 + _squared(J, f, d) / (scale * tolerances).square()).square()
        reg = (PRIOR_SHARE * now.sum((0, 2)) + PRIOR_FLOOR) * stiffness.clamp(min=1e-12)
        A = torch.einsum("vtn,vtnki,vtnkj->tij", now, J, J) + reg[:, None, None] * eye
        b = torch.einsum("vtn,vtnki,vtnk->ti", now, J, f) + reg[:, None] * priors
        d = torch.linalg.solve(A, b)
    d = torch.where((total > 0)[:, None], d, priors)
    inlier = w * (_squared(J, f, d) < (INLIER_SCALE * tolerances).square())
    of_view, agreed = w.sum(2), inlier.sum(2)  # [V, T]
    return Lifted(
        d,
        agreed.sum(0) / total.clamp(min=1e-12),
        ((agreed > share * of_view) & (of_view > 0)).sum(0),
    )


def _squared(J: Tensor, f: Tensor, d: Tensor) -> Tensor:
    """Squared residual of the flow under a displacement ``[T, 3]``, ``[V, T, N]`` square pixels."""
    return (torch.einsum("vtnki,ti->vtnk", J, d) - f).square().sum(-1)


SUPPORTING, CONTRADICTING = 0.3, 0.05
"""A view supports a point at pixels with ``missing`` above the first, and contradicts it below the second."""
FRONT_SHARE = 1.03
"""A point counts as in front of the rendered depth up to this multiple of it."""
MAX_DIFFERENCE = 0.3
MISS_COST, LONELY_COST = 0.15, 0.05
EQUAL_COST = 0.01


def sweep(
    views: Sequence[SweepView],
    view_index: int,
    pixels: Tensor,
    farthest: Tensor,
    *,
    planes: int,
    min_supports: int,
    max_contradictions: float,
) -> Swept:
    """For each ray the depth of least cost among ``planes`` candidates, evenly spaced in inverse depth.

    A view supports a point that projects to a pixel with missing content, in front of the rendered depth; it
    contradicts a point that projects to a pixel without missing content and would be visible. The cost is the mean
    colour difference over the supports (each at most 0.3) + 0.15 times the share of contradictions + 0.05 / number
    of supports. Of the run of depths around the minimum that cost at most 0.01 more, the middle one is taken.

    Args:
        views: all of them.
        view_index: the view whose pixels' rays are swept.
        pixels: ``[P, 2]`` int64, column and row.
        farthest: ``[P]`` depth at which each ray ends; it starts at the view's near plane.
        planes: candidate depths per ray.
        min_supports: number of supports that a valid point needs.
        max_contradictions: largest share of contradictions among supports and contradictions of a valid point.
    """
    own = views[view_index]
    x, y = pixels.unbind(1)
    steps = torch.linspace(0.0, 1.0, planes, dtype=farthest.dtype, device=farthest.device)
    inverse = 1.0 / own.near + steps * (1.0 / farthest[:, None] - 1.0 / own.near)
    z = 1.0 / inverse  # [P, planes]
    fx, fy, cx, cy = own.K[0, 0], own.K[1, 1], own.K[0, 2], own.K[1, 2]
    rays = torch.stack([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, torch.ones_like(farthest)], -1)
    points = rays[:, None] * z[..., None] - own.viewmat[:3, 3]
    points = points @ own.viewmat[:3, :3]  # rows of points times R is R^T times points
    colors = own.colors[y, x]
    supports, contradictions, difference = (torch.zeros_like(z) for _ in range(3))
    for index, view in enumerate(views):
        if index == view_index:
            continue
        seen = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        depth = seen[..., 2]
        front = depth > view.near
        safe = torch.where(front, depth, 1.0)
        column = (view.K[0, 0] * seen[..., 0] / safe + view.K[0, 2]).floor()
        row = (view.K[1, 1] * seen[..., 1] / safe + view.K[1, 2]).floor()
        height, width = view.missing.shape
        inside = front & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        at = (row.clamp(0, height - 1).long(), column.clamp(0, width - 1).long())
        visible = inside & (depth < FRONT_SHARE * view.depths[at])
        supporting = visible & (view.missing[at] > SUPPORTING)
        mismatch = (view.colors[at] - colors[:, None]).abs().mean(-1).clamp(max=MAX_DIFFERENCE)
        supports += supporting
        difference += supporting * mismatch
        contradictions += visible & (view.missing[at] < CONTRADICTING)
    share = contradictions / (supports + contradictions).clamp(min=1.0)
    some = supports.clamp(min=1.0)
    costs = difference / some + MISS_COST * share + LONELY_COST / some
    costs = torch.where((supports >= min_supports) & (share <= max_contradictions), costs, torch.inf)
    least, plane = _middle_of_cheapest(costs)
    return Swept(torch.where(least.isfinite(), z.gather(1, plane)[:, 0], 0.0), least)


def _middle_of_cheapest(costs: Tensor) -> tuple[Tensor, Tensor]:
    """Least cost ``[P]`` of each row of ``costs`` ``[P, planes]``, and the middle plane ``[P, 1]`` of the run of nearly
    equal costs around it, as on textureless surfaces."""
    planes = costs.shape[1]
    best = costs.argmin(1, keepdim=True)
    least = costs.gather(1, best)
    worse = ~(costs <= least + EQUAL_COST)
    plane = torch.arange(planes, device=costs.device).expand_as(costs)
    first = torch.where(worse & (plane < best), plane, -1).amax(1, keepdim=True) + 1
    last = torch.where(worse & (plane > best), plane, planes).amin(1, keepdim=True) - 1
    return least[:, 0], (first + last) // 2


MIN_DEPTH = 1e-6
UNSEEN = -1.0


def plane_scores(
    picture: Tensor, neighbours: Sequence[Tensor], homographies: Tensor, *, window: int, noise: float
) -> Tensor:
    """Correlation ``[P, H, W]`` of a picture with its neighbours, warped through each of ``P`` planes.

    For each neighbour the zero-mean normalised cross-correlation over ``window`` x ``window`` pixels of the picture
    with the neighbour's bilinear samples; -1 if it does not see the whole window. A score is the mean of the better
    half of the neighbours (rounded up), where one that does not see the window counts half of the best. Tensors are on
    the CPU.

    Args:
        picture: ``[H, W]`` grey, in 0 ... 1.
        neighbours: ``N`` grey pictures ``[h, w]``, at least one.
        homographies: ``[P, N, 3, 3]`` float64, from pixel indices of the picture to those of each neighbour.
        window: side in pixels, odd.
        noise: added to variances, so that textureless windows correlate with none.
    """
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
    """Bilinear samples of ``picture`` at the warped pixels of a picture of ``size``, 0 outside it, and the mask of the
    pixels inside it."""
    height, width = picture.shape
    rows, columns = (torch.arange(length).to(picture) for length in size)
    places = torch.stack([columns.expand(*size), rows[:, None].expand(*size), torch.ones(size).to(picture)], dim=-1)
    u, v, depth = (places @ homography.T).unbind(-1)
    x, y = u / depth, v / depth
    seen = (depth > MIN_DEPTH) & (x >= 0.0) & (x <= width - 1) & (y >= 0.0) & (y <= height - 1)
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
