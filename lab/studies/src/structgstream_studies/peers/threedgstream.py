# SPDX-License-Identifier: Apache-2.0
"""3DGStream (Sun et al. 2024): a cache of transformations moves frame 0's Gaussians on, frame by frame.

::

    base(t-1), decoded --> [ 150 steps: cache ] --> float16 --> base(t) --> [ 100 steps: additions ] --> sent with cache
                                 |                                  |  ^
                                 '-- gradients of the last 20       |  '-- spawned where gradients are large
    base(t+1) starts here <-----------------------------------------'      dropped with the frame
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.errors import StreamError
from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import Backend
from structgstream.scene.color import CameraColor
from structgstream.session.pipeline import FrameTask, Past
from structgstream.training.frame0.fit import rig_extent
from structgstream.training.losses import GradientStatistics, ViewLoss, picture_loss
from structgstream.training.optim import Adam, Hooks, LastPass, Schedule, leaves, minimize
from structgstream.training.result import FitResult, Stopwatch
from structgstream.training.views import View, shuffled_views
from structgstream_studies.peers.additions import AdditionsConfig, fit_additions, spawned_at
from structgstream_studies.peers.gaussians import LOSSES, GaussiansConfig, fit_gaussians
from structgstream_studies.peers.hash_grid import Cache, GridConfig, GridQuery, transformation
from structgstream_studies.peers.method import Arrays, PicturesOnly, stored
from structgstream_studies.peers.plain import PlainGaussians, moved
from structgstream_studies.peers.plain_arrays import color_of, gaussians_of, tensor_of, with_prefix
from structgstream_studies.peers.warm_up import WarmUpConfig, warm_up


@dataclass(frozen=True)
class ThreeDGStreamConfig:
    """What 3DGStream ships for its flame-steak scene, on a frame 0 of this project's length."""

    initial: GaussiansConfig = field(default_factory=GaussiansConfig)
    grid: GridConfig = field(default_factory=GridConfig)
    warm_up: WarmUpConfig = field(default_factory=WarmUpConfig)
    box_share: float = 0.866
    """Central share of the Gaussians along each axis that the cache's box holds; those outside do not move."""
    iterations: int = 150
    rate: float = 2e-3
    eps: float = 1e-8
    """Adam's, as torch has it: the published code sets none."""
    shift_scale: float = 0.1
    """Scene units of a shift of one. The published network's shifts are in the units of its captures, whose boxes are
    some twenty units wide; here they are about two (docs/peers.md)."""
    collect_from: int = 130
    """View-space gradients are collected after this iteration."""
    additions: AdditionsConfig = field(default_factory=AdditionsConfig)


@dataclass(frozen=True)
class StreamedGaussians:
    """A frame as a receiver holds it.

    Args:
        base: frame 0's Gaussians where the caches so far have brought them.
        added: this frame's additions.
        camera_color: of the training cameras, from frame 0; only the trainer looks at it.
        box: ``[2, 3]`` lowest and highest corner of the cache's box, scene units.
        cache: the float16 cache that brought ``base`` here; None in frame 0.
    """

    base: PlainGaussians
    added: PlainGaussians
    camera_color: CameraColor
    box: Tensor
    cache: Cache | None

    def __len__(self) -> int:
        return len(self.base) + len(self.added)

    def gaussians(self, camera: Camera, backend: Backend) -> Gaussians:
        """What ``camera`` sees."""
        return self.base.joined(self.added).gaussians(camera, backend)

    def on_device(self, device: torch.device) -> "StreamedGaussians":
        """The same with its tensors on ``device``, without the cache, which has done its work."""
        color = CameraColor(self.camera_color.gains.to(device), self.camera_color.biases.to(device))
        base, added = self.base.on_device(device), self.added.on_device(device)
        return StreamedGaussians(base, added, color, self.box.to(device), None)


def box_of(means: Tensor, share: float) -> Tensor:
    """The box ``[2, 3]`` of the central ``share`` of ``means`` along each axis."""
    outside = means.new_tensor([0.5 * (1.0 - share), 0.5 * (1.0 + share)])
    return torch.quantile(means, outside, dim=0)


def in_box(means: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
    """Rows of ``means`` inside ``box``, and these in units of the box: ``[n]``, ``[n, 3]``."""
    positions = (means - box[0]) / (box[1] - box[0]).clamp(min=1e-12)
    rows = ((positions >= 0) & (positions <= 1)).all(1).nonzero()[:, 0]
    return rows, positions[rows]


def apply_transformation(base: PlainGaussians, rows: Tensor, outputs: Tensor, shift_scale: float) -> PlainGaussians:
    """``base`` with ``rows`` moved as the network's ``outputs`` ``[n, 8]`` say."""
    shifts = base.means.new_zeros(base.means.shape).index_copy(0, rows, outputs[:, :3] * shift_scale)
    stays = torch.zeros_like(base.quats)
    stays[:, 0] = 1.0
    return moved(base, shifts, stays.index_copy(0, rows, outputs[:, 3:7]))


@dataclass
class _TransformationHooks(Hooks[View, ViewLoss]):
    """What the first stage does in an iteration: move ``rows`` of the base by the cache, as ``query`` asks it."""

    config: ThreeDGStreamConfig
    adam: Adam[str]
    state: StreamedGaussians
    rows: Tensor
    query: GridQuery
    statistics: GradientStatistics
    watch: Stopwatch
    last_pass: LastPass

    def loss(self, iteration: int, sample: View) -> ViewLoss:
        config, state, backend, watch = self.config, self.state, self.adam.backend, self.watch
        with watch.stage("transform"):
            outputs = transformation(Cache.of(self.adam.values), self.query, config.grid)
            gaussians = apply_transformation(state.base, self.rows, outputs, config.shift_scale)
        with watch.stage("generate"):
            drawn = gaussians.gaussians(sample.camera, backend)
        collects = iteration > config.collect_from
        loss = picture_loss(
            drawn, sample, state.camera_color, backend=backend, weights=LOSSES, track_screen=collects, watch=watch
        )
        self.last_pass.add(iteration, loss, sample)
        return loss

    def after_step(self, iteration: int, sample: View, loss: ViewLoss, screen_gradient: Tensor | None) -> None:
        if screen_gradient is not None:
            self.statistics.add(loss.rendering, screen_gradient)

    def counts(self) -> tuple[int, int]:
        return 0, len(self.state.base)

    def parents(self) -> Tensor:
        """Mask of the Gaussians of the base that have a child: those inside the box that pull hard."""
        inside = torch.zeros(len(self.state.base), dtype=torch.bool, device=self.rows.device)
        return (self.statistics.mean() >= self.config.additions.gradient) & inside.index_fill(0, self.rows, True)


@dataclass(frozen=True)
class ThreeDGStream(PicturesOnly):
    """The method behind the loop; its memory is the warmed-up cache."""

    config: ThreeDGStreamConfig = field(default_factory=ThreeDGStreamConfig)
    name: str = "3dgstream"
    stands_alone: bool = False

    def first(self, task: FrameTask) -> FitResult[StreamedGaussians]:
        """Frame 0: plain Gaussians from scratch."""
        fit = fit_gaussians(
            task.frame,
            task.rig,
            task.points(),
            config=self.config.initial,
            backend=task.backend,
            seed=task.seed,
            on_step=task.on_step,
        )
        base, color = fit.scene.gaussians, fit.scene.camera_color
        none = PlainGaussians.empty(base.degree, base.means)
        scene = StreamedGaussians(base, none, color, box_of(base.means, self.config.box_share), None)
        return FitResult(**{**vars(fit), "scene": scene})

    def prepare(self, state: StreamedGaussians, task: Callable[[], FrameTask]) -> Cache:
        """The cache that every frame starts from."""
        first, config = task(), self.config
        _, positions = in_box(state.base.means, state.box)
        return warm_up(positions, config=config.warm_up, grid=config.grid, backend=first.backend, seed=first.seed)[0]

    def next(self, past: Past[StreamedGaussians, Cache], task: FrameTask) -> FitResult[StreamedGaussians]:
        """Both stages of a later frame."""
        config, state, base, backend = self.config, past.state, past.state.base, task.backend
        generator, watch = torch.Generator().manual_seed(task.seed), Stopwatch()
        views = task.pictures.views
        order = shuffled_views(views, generator)
        with watch.stage("look up"):
            rows, positions = in_box(base.means, state.box)
            query = GridQuery.of(positions, config.grid)
        adam = Adam(backend, leaves(past.memory.tensors()), config.eps)
        last_pass = LastPass(config.iterations - len(views))
        hooks = _TransformationHooks(
            config, adam, state, rows, query, GradientStatistics(len(base), backend.device), watch, last_pass
        )
        rates = dict.fromkeys(adam.values, config.rate)
        schedule = Schedule(config.iterations, lambda _: rates, after=config.additions.iterations)
        minimize(adam, order, schedule, hooks, watch=watch, on_step=task.on_step)
        fitted = replace(state, cache=Cache.of(adam.values).as_stored())
        decoded = self._moved(fitted, rows, query)
        parents = decoded.select(hooks.parents())
        result = fit_additions(
            spawned_at(parents, config.additions, generator),
            decoded,
            state.camera_color,
            order,
            config=config.additions,
            extent=rig_extent(task.rig),
            views=len(views),
            backend=backend,
            watch=watch,
            before=config.iterations,
            on_step=task.on_step,
        )
        return FitResult(
            scene=replace(fitted, base=decoded, added=result.added),
            iterations=config.iterations + config.additions.iterations,
            train_psnr=last_pass.psnr if result.train_psnr is None else result.train_psnr,
            seconds=watch.seconds,
            spawned=len(parents),
            pruned=len(parents) - len(result.added),
        )

    def _moved(self, state: StreamedGaussians, rows: Tensor, query: GridQuery) -> PlainGaussians:
        """The base moved by the state's float16 cache: what the receiver computes."""
        assert state.cache is not None
        with torch.no_grad():
            outputs = transformation(state.cache.as_float(), query, self.config.grid)
            return apply_transformation(state.base, rows, outputs, self.config.shift_scale)

    def arrays(self, state: StreamedGaussians) -> Arrays:
        """Frame 0: Gaussians, camera colour and box. Later: the cache in float16 and the additions."""
        if state.cache is None:
            color = torch.cat([state.camera_color.gains, state.camera_color.biases], dim=1)
            return with_prefix("base", state.base) | {"camera_color": stored(color), "box": stored(state.box)}
        half = torch.float16
        cache: Arrays = {name: stored(value, half) for name, value in state.cache.tensors().items()}
        return cache | with_prefix("added", state.added)

    def restored(
        self, arrays: Mapping[str, NDArray[Any]], previous: StreamedGaussians | None, *, device: torch.device
    ) -> StreamedGaussians:
        """The decoder.

        Raises:
            StreamError: the arrays are not those of this method, or the frame needs one before it.
        """
        if previous is None:
            base = gaussians_of(arrays, "base", device)
            color, box = color_of(arrays, device), tensor_of(arrays, "box", (2, 3), device)
            return StreamedGaussians(base, PlainGaussians.empty(base.degree, base.means), color, box, None)
        grid = self.config.grid
        cache = Cache(
            tensor_of(arrays, "grid", (grid.total_rows, grid.features), device, torch.float16),
            tensor_of(arrays, "network", (grid.weights,), device, torch.float16),
        )
        added = gaussians_of(arrays, "added", device)
        if added.degree != previous.base.degree:
            raise StreamError(f"Additions have colours of degree {added.degree}, the others {previous.base.degree}.")
        rows, positions = in_box(previous.base.means, previous.box)
        state = replace(previous, added=added, cache=cache)
        return replace(state, base=self._moved(state, rows, GridQuery.of(positions, grid, gradients=False)))
