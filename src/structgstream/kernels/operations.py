# SPDX-License-Identifier: Apache-2.0
"""The operations of a back-end: their signatures and contracts, the same for all back-ends.

A back-end has one function for each (``kernels.backend``); the type checker rejects another signature.

Note [Ownership]
~~~~~~~~~~~~~~~~
The same on every back-end:

- Arguments are neither changed nor aliased by results, with two exceptions. ``Rasterize`` draws into ``onto`` in place:
  the returned ``image`` shares its memory, so the next drawing into it changes both. ``AdamStep`` updates ``param`` and
  its two moments in place.
- Results belong to the caller.
- Cameras, targets, masks and numbers get no gradient; every other tensor gets one if it requires it. ``ids``,
  ``anchors``, ``raw_opacities`` and ``radii`` of results have no graph.
- Indices are int64 and ascending, masks bool.
- If memory is short a kernel raises ``OutOfMemoryError``. Tensors that a back-end does not support raise
  ``BackendError``, which names a back-end that supports them.
"""

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians
from structgstream.kernels.anchor_types import Anchors, MLPWeights, StructuredGaussians
from structgstream.kernels.motion_types import Lifted, Neighbors, SweepView, Swept, ViewFlows
from structgstream.kernels.raster_types import RasterOutput, TileSelection


class Rasterize(Protocol):
    """Draw ``N`` Gaussians (paper, equations for mu_2D, Sigma_2D and alpha blending).

    A Gaussian that less than 1/255 of a pixel's light reaches is drawn there, and gets no gradient from the pixel; with
    gsplat (``cuda``) it does. The low-pass is ``reference_raster.screen_low_pass``; it counts as a constant.

    Args:
        gaussians: to draw; their ids are not read.
        viewport: the camera.
        background: ``[3]``, black when None.
        screen_offsets: ``[N, 2]`` pixels, added to the projected means; its gradient is the view-space positional
            gradient.
        tiles: the tiles to draw, all when None. A Gaussian that reaches none of them has radius 0.
        onto: ``[H, W, 3]`` without gradient, contiguous, only with ``tiles``: the picture that is drawn into in
            place (Note [Ownership]), so that the other tiles keep its pixels; they are zero when None.
        trained: only the first ``trained`` Gaussians get gradients; all when None.
    """

    def __call__(
        self,
        gaussians: Gaussians,
        viewport: Viewport,
        *,
        background: Tensor | None = None,
        screen_offsets: Tensor | None = None,
        tiles: TileSelection | None = None,
        onto: Tensor | None = None,
        trained: int | None = None,
    ) -> RasterOutput: ...


class BlendingWeights(Protocol):
    """Sums ``[N, C]`` over the pixels of each Gaussian's blending weight times each map, without graph.

    Weights are the gradients of ``Rasterize`` by colour: those of Gaussians that hardly any light reaches are zero.

    Args:
        gaussians: to draw; their colours and ids are not read.
        viewport: the camera.
        maps: ``[H, W, C]`` of the viewport's size, C at least 1.
    """

    def __call__(self, gaussians: Gaussians, viewport: Viewport, maps: Tensor) -> Tensor: ...


class PictureAndWeights(Protocol):
    """The picture ``[H, W, 3]`` of ``Rasterize`` and the sums ``[N, C]`` of ``BlendingWeights``, without graph.

    Args:
        gaussians: to draw; their ids are not read.
        viewport: the camera.
        maps: as for ``BlendingWeights``.
        background: ``[3]``, black when None.
    """

    def __call__(
        self, gaussians: Gaussians, viewport: Viewport, maps: Tensor, *, background: Tensor | None = None
    ) -> tuple[Tensor, Tensor]: ...


class L1SSIM(Protocol):
    """Mean absolute difference and mean SSIM of ``gains * image + biases`` against ``target``.

    Args:
        image: ``[H, W, 3]``; the only argument with a gradient.
        target: ``[H, W, 3]``, float in [0, 1] or uint8.
        gains: ``[3]``; one when None.
        biases: ``[3]``; given with ``gains``.
        tiles: if given, pixels of the other tiles count as equal (difference 0, SSIM 1); those up to ten pixels
            from the selected tiles are still read. The gradient is that of the whole picture in the selected
            tiles, and zero in the others.
    """

    def __call__(
        self,
        image: Tensor,
        target: Tensor,
        *,
        gains: Tensor | None = None,
        biases: Tensor | None = None,
        tiles: TileSelection | None = None,
    ) -> tuple[Tensor, Tensor]: ...


class Volume(Protocol):
    """Sum of the products of the three scales ``[N, 3]``, and the number of opacities ``[N]`` above zero.

    Gradients flow to ``scales``.
    """

    def __call__(self, scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]: ...


class Excess(Protocol):
    """Sum ``[]`` of max(|offsets ``[M, K, 3]`` x exp(log_scales ``[M, 3]``)| - ``limit``, 0)."""

    def __call__(self, offsets: Tensor, log_scales: Tensor, limit: float) -> Tensor: ...


class NeighbourDifference(Protocol):
    """How much rows differ from their neighbours: the sum ``[]`` of shares times smoothed distances.

    The distance of two rows is ``sqrt(|difference|^2 + slack^2) - slack``. Gradients flow to ``values``.

    Args:
        values: ``[M, 3]``.
        neighbours: ``[M, N]`` int64, rows that each is compared with.
        shares: ``[M, N]`` weights of these pairs.
        slack: positive; far below it distances count in proportion to their square.
    """

    def __call__(self, values: Tensor, neighbours: Tensor, shares: Tensor, *, slack: float) -> Tensor: ...


class ChangeBits(Protocol):
    """Sum ``[]`` of log2(1 + |values - before| / step) over all numbers of all tensors; gradients flow to ``values``.

    Args:
        values: any shapes.
        before: of the same shapes, without gradient.
        steps: one for each tensor.
    """

    def __call__(self, values: Sequence[Tensor], before: Sequence[Tensor], steps: Sequence[float]) -> Tensor: ...


class ChangedPixels(Protocol):
    """Dilated mask ``[H, W]`` of the pixels that changed between two pictures ``[H, W, 3]`` uint8.

    A pixel has changed when the mean absolute difference over its 3 x 3 neighbourhood (inside the picture) and the
    channels exceeds ``threshold``. Sums are of integers, so every back-end gives the same mask.

    Args:
        before: the camera's earlier picture.
        now: its later picture.
        threshold: in 0 ... 1, above the sensor's noise.
        reach_pixels: half width of the square by which the mask is dilated, pixels.
    """

    def __call__(self, before: Tensor, now: Tensor, *, threshold: float, reach_pixels: int) -> Tensor: ...


class PictureResidual(Protocol):
    """Mean absolute difference ``[h, w]`` of a rendering to a picture, over channels and the 3 x 3 pixels around each
    that exist, in 0 ... 1; without graph.

    The rendering is compared as its camera would have recorded it: ``gains * rendering + biases``, clamped to 0 ... 1,
    and averaged down to the picture's size.

    Args:
        rendering: ``[H, W, 3]``.
        picture: ``[h, w, 3]`` uint8, not larger than the rendering.
        gains: ``[3]``; one when None.
        biases: ``[3]``; given with ``gains``.
        tiles: outside of these tiles of the rendering ``outside`` takes its place.
        outside: ``[H, W, 3]`` uint8; given with ``tiles``.
        mask: ``[h, w]`` bool; pixels where it is False do not differ.
    """

    def __call__(
        self,
        rendering: Tensor,
        picture: Tensor,
        *,
        gains: Tensor | None = None,
        biases: Tensor | None = None,
        tiles: TileSelection | None = None,
        outside: Tensor | None = None,
        mask: Tensor | None = None,
    ) -> Tensor: ...


class ConfidentFlow(Protocol):
    """Maps ``[3, H, W]`` of c, c flow_x and c flow_y, where c is 1 if flow there and back agree (forward-backward
    consistency, Sundaram et al., 2010), else 0.

    With ``f`` the flow and ``b`` the flow back: ``|f(p) + b(p + f(p))|^2 <= relative (|f(p)|^2 + |b(p + f(p))|^2) +
    absolute``, and ``p + f(p)`` lies inside the outermost pixel centres. Tensors are on the CPU, where flow is found.

    Args:
        flow: ``[H, W, 2]`` float32, pixels.
        back: ``[H, W, 2]`` float32, from the second picture to the first.
        mask: ``[H, W]`` bool, c is 0 elsewhere; None for all pixels.
        relative: share of the squared lengths.
        absolute: squared pixels.
    """

    def __call__(
        self, flow: Tensor, back: Tensor, mask: Tensor | None, *, relative: float, absolute: float
    ) -> Tensor: ...


class Lift(Protocol):
    """For each of ``T`` targets the 3D displacement d that fits its neighbours' optical flow in all views.

    Minimises ``sum g W rho(J d - f) + reg |d - prior|^2`` over neighbours and views by iteratively reweighted least
    squares: one round without robust weights, then Geman-McClure weights ``1 / (1 + r^2 / (s tau)^2)^2`` of decreasing
    scale s (``reference_lift.ROBUST_SCALES``), with the residual ``r = |J d - f|`` and the tolerance ``tau = 1 +
    0.1 |f|``. What has ``r < 1.5 tau`` in the end is an inlier. ``reg`` is ``0.02 sum + 0.05`` times the mean
    square of J, with the sum of the present weights.

    Args:
        centers: ``[E, 3]`` of movers.
        seen: W and f of the movers in each view.
        neighbours: of each target, and g.
        priors: ``[T, 3]`` displacements.
        share: as in :class:`Lifted`.
    """

    def __call__(
        self, centers: Tensor, seen: ViewFlows, neighbors: Neighbors, priors: Tensor, *, share: float
    ) -> Lifted: ...


class Sweep(Protocol):
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
        least_supports: number of supports that a valid point needs.
        most_contradictions: largest share of contradictions among supports and contradictions of a valid point.
    """

    def __call__(
        self,
        views: Sequence[SweepView],
        view_index: int,
        pixels: Tensor,
        farthest: Tensor,
        *,
        planes: int,
        least_supports: int,
        most_contradictions: float,
    ) -> Swept: ...


class PlaneScores(Protocol):
    """How well a picture correlates with its neighbours seen through each of ``P`` planes: ``[P, H, W]``.

    For each neighbour the zero-mean normalised cross-correlation over ``window`` x ``window`` pixels of the picture
    with the neighbour's bilinear samples; -1 where it does not see the whole window. A score is the mean of the better
    half of the neighbours (rounded up), in which one that does not see the window counts half of the best. Tensors
    are on the CPU.

    Args:
        picture: ``[H, W]`` grey, in 0 ... 1.
        neighbours: ``N`` grey pictures ``[h, w]``, at least one.
        homographies: ``[P, N, 3, 3]`` float64, from pixel indices of the picture to those of each neighbour.
        window: side in pixels, odd.
        noise: added to variances, so that textureless windows correlate with none.
    """

    def __call__(
        self, picture: Tensor, neighbours: Sequence[Tensor], homographies: Tensor, *, window: int, noise: float
    ) -> Tensor: ...


class GenerateStructured(Protocol):
    """The Gaussians of the anchors in a camera's view (paper, equations for mu' and Sigma').

    Opacity is the tanh output; only positive ones are drawn. The scale is the base scale times a sigmoid. Culling
    changes the cost of a rendering, never its pixels: it tests a ball that contains all Gaussians of an anchor.

    Args:
        anchors: all of the scene's.
        mlps: the three heads; inputs are the feature (D), the direction (3) and optionally the distance (1).
        viewport: the camera.
        distance_input: whether the distance is an input of the heads.
        tiles: if given, only anchors that reach one of these tiles.
        seen_from: ``[3]`` origin of direction and distance; the viewport's centre when None.
        sampling_intervals: ``[M]`` of the anchors, by which their balls grow for the low-pass (:class:`Rasterize`).
    """

    def __call__(
        self,
        anchors: Anchors,
        mlps: MLPWeights,
        viewport: Viewport,
        *,
        distance_input: bool,
        tiles: TileSelection | None = None,
        seen_from: Tensor | None = None,
        sampling_intervals: Tensor | None = None,
    ) -> StructuredGaussians: ...


class AdamStep(Protocol):
    """Update ``param`` in place by one step of ``torch.optim.Adam`` (Note [Ownership]).

    Args:
        param: any shape.
        grad: like ``param``.
        exp_avg: first moment, updated in place.
        exp_avg_sq: second moment, updated in place.
        lr: learning rate; on a GPU also ``[]`` float32 there, read when the work runs (``cuda_graph``).
        step: number of this step, from 1; likewise.
        betas: decay of the moments.
        eps: added to the root of the corrected second moment.
    """

    def __call__(
        self,
        param: Tensor,
        grad: Tensor,
        exp_avg: Tensor,
        exp_avg_sq: Tensor,
        *,
        lr: float | Tensor,
        step: int | Tensor,
        betas: tuple[float, float],
        eps: float,
    ) -> None: ...
