# SPDX-License-Identifier: Apache-2.0
"""The operations of a back-end: each one's signature and contract, once for all back-ends.

A back-end gives a function for each (``kernels.backend``); the type checker refuses one with another signature.

Note [Ownership]
~~~~~~~~~~~~~~~~
The same on every back-end:

- What is given is read, and neither changed nor kept as a result's memory, but for two. ``Rasterize`` draws into
  ``onto``, which is the picture afterwards: the ``image`` that is returned lies in its memory, and the next drawing
  onto it changes both. ``AdamStep`` moves ``param`` and its two moments in place.
- What is returned belongs to the caller.
- Cameras, targets, masks and numbers get no gradient; every other tensor gets one if it requires it. What counts or
  chooses (``ids``, ``anchors``, ``raw_opacities``, ``radii``) has no graph.
- Indices are int64 and ascending, masks bool.
- A kernel that needs more memory than there is raises ``OutOfMemoryError``; tensors that a back-end cannot compute with
  raise ``BackendError``, which names a back-end that can.
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

    Args:
        gaussians: what is drawn; their ids play no part.
        viewport: where from, and the size of the picture.
        background: ``[3]``, black when None.
        screen_offsets: ``[N, 2]`` pixels, added to the projected means; its gradient is the view-space positional
            gradient.
        tiles: what to draw, everything when None. A Gaussian that reaches none of them counts as not drawn.
        onto: ``[H, W, 3]`` without gradient, contiguous, given with ``tiles``: what the picture shows in the other
            tiles, else zero. Drawn into (Note [Ownership]).
        trained: only so many Gaussians, the first ones, get gradients; all when None.
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
    """For each Gaussian the sum over the pixels of its blending weight times each map, ``[N, C]``, without graph.

    Args:
        gaussians: what is drawn; their colours and ids play no part.
        viewport: where from.
        maps: ``[H, W, C]`` of the viewport's size, C at least 1.
    """

    def __call__(self, gaussians: Gaussians, viewport: Viewport, maps: Tensor) -> Tensor: ...


class L1SSIM(Protocol):
    """Mean absolute difference and mean SSIM of ``gains * image + biases`` against ``target``.

    Args:
        image: ``[H, W, 3]``; gradients flow here only.
        target: ``[H, W, 3]``, float in [0, 1] or uint8.
        gains: ``[3]``; one when None.
        biases: ``[3]``; given with ``gains``.
        tiles: pixels of the other tiles count as equal (difference 0, SSIM 1); they are still read, up to ten
            pixels from the tiles that count. The gradient is that of the whole picture in the tiles, and zero in
            the others.
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
    """The product of the three scales ``[N, 3]``, summed, and the number of opacities ``[N]`` above zero.

    Gradients flow to ``scales``.
    """

    def __call__(self, scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]: ...


class Excess(Protocol):
    """The parts of |offsets ``[M, K, 3]`` x exp(log_scales ``[M, 3]``)| beyond ``limit``, summed, ``[]``."""

    def __call__(self, offsets: Tensor, log_scales: Tensor, limit: float) -> Tensor: ...


class ChangedPixels(Protocol):
    """Mask ``[H, W]`` of what changed between two pictures ``[H, W, 3]`` uint8, and its surroundings.

    A pixel has changed when the mean absolute difference of the 3 x 3 pixels around it (those that exist), over the
    channels, exceeds ``threshold`` (in 0 ... 1). Sums are of integers: every back-end finds the same pixels.

    Args:
        before: the camera's earlier picture.
        now: its later picture.
        threshold: above the sensor's noise.
        reach_pixels: pixels up to this far from a changed one, across or down, count as well.
    """

    def __call__(self, before: Tensor, now: Tensor, *, threshold: float, reach_pixels: int) -> Tensor: ...


class Lift(Protocol):
    """For each of ``T`` targets the displacement d that explains the flow of its neighbours best, in all views.

    Minimises ``sum g W rho(J d - f) + reg |d - prior|^2`` over neighbours and views, with Geman-McClure weights
    ``1 / (1 + r^2 / s^2)^2`` of falling scale s (``reference_lift.ROBUST_PIXELS``) after one round without them.
    ``reg = (0.02 sum + 0.05)`` times the mean square of J, where ``sum`` is that of the present weights.

    Args:
        centers: ``[E, 3]`` of movers.
        seen: W and f of the movers in each view.
        neighbours: of each target, and g.
        priors: ``[T, 3]``.
        share: of :class:`Lifted`.
    """

    def __call__(
        self, centers: Tensor, seen: ViewFlows, neighbors: Neighbors, priors: Tensor, *, share: float
    ) -> Lifted: ...


class Sweep(Protocol):
    """For each ray the cheapest of ``planes`` depths, evenly spaced in inverse depth.

    A view supports a point that falls into its picture where something is missing and in front of what is rendered
    there; it contradicts one where nothing is missing and the point would be seen. The cost is the mean difference
    of colour over the supports (each at most 0.3), 0.15 times the share of contradictions, and 0.05 over the
    supports. Of the depths around the cheapest that cost at most 0.01 more the middle one is taken.

    Args:
        views: all of them.
        view_index: whose rays.
        pixels: ``[P, 2]`` int64, column and row.
        farthest: ``[P]`` depth at which each ray ends; it begins at the view's near plane.
        planes: points on a ray.
        least_supports: a point needs so many ...
        most_contradictions: ... and at most this share of contradictions among both.
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


class GenerateStructured(Protocol):
    """The Gaussians of the anchors that a camera may see (paper, equations for mu' and Sigma').

    Opacity is tanh and used as it is, so that only what is positive is drawn; the scale is the base times a
    sigmoid. Which anchors are looked at changes the cost of a rendering and never its pixels: an anchor counts as a
    ball that holds all its Gaussians.

    Args:
        anchors: all of the scene's.
        mlps: the three heads; inputs are the feature, the direction (3) and, if asked for, the distance (1).
        viewport: where from.
        distance_input: whether the heads see the distance.
        tiles: only what reaches one of these tiles counts.
        seen_from: ``[3]``, whence direction and distance are taken; the viewport's centre when None.
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
    ) -> StructuredGaussians: ...


class AdamStep(Protocol):
    """Move ``param`` in place by one step, as ``torch.optim.Adam`` does (Note [Ownership]).

    Args:
        param: any shape.
        grad: like ``param``.
        exp_avg: first moment, updated in place.
        exp_avg_sq: second moment, updated in place.
        lr: learning rate.
        step: number of this step, from 1.
        betas: decay of the moments.
        eps: added to the root of the corrected second moment.
        rows: ``[r]`` int64, none twice; only these rows (first dimension) are touched. None: all.
    """

    def __call__(
        self,
        param: Tensor,
        grad: Tensor,
        exp_avg: Tensor,
        exp_avg_sq: Tensor,
        *,
        lr: float,
        step: int,
        betas: tuple[float, float],
        eps: float,
        rows: Tensor | None = None,
    ) -> None: ...
