# SPDX-License-Identifier: Apache-2.0
"""3D Gaussian splatting (Kerbl et al., 2023): fits one frame from scratch."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.errors import CaptureError
from structgstream.frames import MultiViewFrame
from structgstream.harmonics import Y0
from structgstream.kernels.backend import Backend
from structgstream.scene.color import CameraColor
from structgstream.scene.state import fields_of, parameters_of
from structgstream.training.frame0.fit import rig_extent
from structgstream.training.frame0.seeding import neighbor_distances, voxel_centers
from structgstream.training.losses import GradientStatistics, LossWeights, ViewLoss, picture_loss
from structgstream.training.optim import Adam, Hooks, LastPass, LearningRate, Schedule, constant, leaves, minimize
from structgstream.training.result import FitResult, StepListener, Stopwatch
from structgstream.training.views import View, coarse_to_fine, training_views
from structgstream_studies.peers.densify import DensifyConfig, densify, reset_opacities
from structgstream_studies.peers.plain import PlainGaussians

CAMERA = parameters_of(fields_of("camera"))
LOSSES = LossWeights(l1=0.8, ssim=0.2)
"""3DGS's."""


@dataclass(frozen=True)
class GaussiansRates:
    """Learning rates of 3DGS, scheduled over the iterations of the fit."""

    means: LearningRate = LearningRate(1.6e-4, 1.6e-6)
    """Times 1.1 rig radii."""
    log_scales: LearningRate = constant(5e-3)
    quats: LearningRate = constant(1e-3)
    logit_opacities: LearningRate = constant(5e-2)
    base_colors: LearningRate = constant(2.5e-3)
    sh: LearningRate = constant(2.5e-3 / 20)
    camera_color: LearningRate = LearningRate(2e-3, 1e-4)
    """As this project's frame 0; unused when ``camera_color`` is off."""


@dataclass(frozen=True)
class GaussiansConfig:
    """Configuration of a frame fitted from scratch with plain Gaussians.

    3DGS runs 30,000 iterations; the schedule here has the length of this project's frame 0, and also starts on reduced
    pictures.
    """

    iterations: int = 4000
    coarse_iterations: int = 2500
    """Number of first iterations on pictures reduced by ``coarse_scale``."""
    coarse_scale: float = 0.5
    sh_degree: int = 1
    """Degree of the spherical harmonics, as 3DGStream's frame 0 (3DGS: 3)."""
    sh_from: int = 1000
    """Iteration from which colours depend on direction (3DGS raises the degree by one every 1,000 iterations)."""
    voxel_size: float = 0.0067
    """Initial points are thinned to one in each voxel, as in this project's frame 0; 0 takes all."""
    initial_opacity: float = 0.1
    camera_color: bool = True
    """Learn a gain and a bias for each training camera, as the preset ``rig`` (scene.color, Note [Colour gauge])."""
    rates: GaussiansRates = field(default_factory=GaussiansRates)
    densify: DensifyConfig = field(default_factory=DensifyConfig)


@dataclass(frozen=True)
class RecordedGaussians:
    """Gaussians, and the training cameras' colour correction."""

    gaussians: PlainGaussians
    camera_color: CameraColor


def point_colors(points: Tensor, views: list[View]) -> Tensor:
    """Median over the views of the colours at the projections of points ``[P, 3]``: ``[P, 3]`` in [0, 1].

    Occlusion is ignored, as colours are only an initialisation. Points outside all views are grey.
    """
    seen = points.new_full((len(views), points.shape[0], 3), float("nan"))
    for row, view in enumerate(views):
        camera = view.camera
        viewport = camera.viewport(points)
        local = points @ viewport.viewmat[:3, :3].T + viewport.viewmat[:3, 3]
        pixels = (local @ viewport.K.T)[:, :2] / local[:, 2:].clamp(min=camera.near)
        size = pixels.new_tensor([camera.width, camera.height])
        shown = (local[:, 2] > camera.near) & (pixels >= 0).all(1) & (pixels < size).all(1)
        columns, rows = pixels[shown].long().unbind(1)
        found = view.image[rows, columns].to(points) / 255.0
        if view.mask is not None:
            found[~view.mask[rows, columns]] = float("nan")
        seen[row, shown] = found
    return seen.nanmedian(dim=0).values.nan_to_num(0.5)


def initial_gaussians(points: Tensor, views: list[View], config: GaussiansConfig) -> PlainGaussians:
    """Isotropic Gaussians at ``points`` ``[P, 3]`` with the distance to neighbours as scale (3DGS).

    Raises:
        CaptureError: fewer than four distinct points.
    """
    device = views[0].image.device
    points = points.float() if config.voxel_size <= 0 else voxel_centers(points.float(), config.voxel_size)
    count = points.shape[0]
    if count < 4:
        raise CaptureError(
            f"Only {count} initial points remain at a voxel size of {config.voxel_size:g}; at least 4 are needed. "
            "Check the poses, or give a capture with more overlap between cameras."
        )
    log_scales = neighbor_distances(points).log()[:, None].expand(count, 3).contiguous()
    means = points.to(device)
    quats = means.new_zeros(count, 4)
    quats[:, 0] = 1.0
    return PlainGaussians(
        means=means,
        log_scales=log_scales.to(device),
        quats=quats,
        logit_opacities=torch.logit(means.new_full((count,), config.initial_opacity)),
        base_colors=(point_colors(means, views) - 0.5) / Y0,
        sh=means.new_zeros(count, (config.sh_degree + 1) ** 2 - 1, 3),
    )


def rates_at(iteration: int, config: GaussiansConfig, *, extent: float) -> dict[str, float]:
    """Rate of every leaf after ``iteration`` steps; ``extent`` is 1.1 rig radii in scene units."""
    share, r = iteration / config.iterations, config.rates
    return {
        "means": r.means.at(share) * extent,
        "log_scales": r.log_scales.at(share),
        "quats": r.quats.at(share),
        "logit_opacities": r.logit_opacities.at(share),
        "base_colors": r.base_colors.at(share),
        "sh": r.sh.at(share) if iteration >= config.sh_from else 0.0,
        **{parameter.name: r.camera_color.at(share) for parameter in CAMERA},
    }


def fit_gaussians(
    frame: MultiViewFrame,
    rig: CameraRig,
    points: Tensor,
    *,
    config: GaussiansConfig,
    backend: Backend,
    seed: int,
    on_step: StepListener | None = None,
) -> FitResult[RecordedGaussians]:
    """Reconstruct one frame from its training views.

    Args:
        frame: the pictures; only those of ``rig.training`` are read. The colour of an absent camera stays neutral.
        rig: cameras in normalised units.
        points: ``[P, 3]`` initial points in normalised units.
        config: the schedule.
        backend: what computes.
        seed: all randomness comes from it.
        on_step: called after every iteration.

    Raises:
        CaptureError: fewer than four distinct points.
    """
    generator, watch, extent = torch.Generator().manual_seed(seed), Stopwatch(), rig_extent(rig)
    views = training_views(frame, rig, backend.device)
    with watch.stage("initialise"):
        start = initial_gaussians(points, views, config)
        identity = CameraColor.identity(len(rig.training), start.means)
        camera = {p.name: getattr(identity, p.attribute) for p in CAMERA} if config.camera_color else {}
        samples = coarse_to_fine(views, [(config.coarse_iterations, config.coarse_scale)], generator=generator)
    adam = Adam(backend, leaves(start.tensors() | camera))
    statistics, last_pass = GradientStatistics(len(start), backend.device), LastPass(config.iterations - len(views))
    hooks = _FromScratchHooks(config, adam, identity, statistics, extent, generator, watch, last_pass)
    schedule = Schedule(config.iterations, lambda iteration: rates_at(iteration, config, extent=extent))
    iterations = minimize(adam, samples, schedule, hooks, watch=watch, on_step=on_step)
    gaussians, color = hooks.parts()
    return FitResult(
        scene=RecordedGaussians(gaussians.detached(), CameraColor(color.gains.detach(), color.biases.detach())),
        iterations=iterations,
        train_psnr=last_pass.psnr,
        spawned=hooks.spawned,
        pruned=hooks.pruned,
        seconds=watch.seconds,
        losses=last_pass.terms,
    )


@dataclass
class _FromScratchHooks(Hooks[View, ViewLoss]):
    """What 3DGS does in an iteration; ``identity`` is the colour correction where none is learned."""

    config: GaussiansConfig
    adam: Adam[str]
    identity: CameraColor
    statistics: GradientStatistics
    extent: float
    generator: torch.Generator
    watch: Stopwatch
    last_pass: LastPass
    spawned: int = 0
    pruned: int = 0

    def parts(self) -> tuple[PlainGaussians, CameraColor]:
        """What the leaves stand for."""
        values = self.adam.values
        color = {p.attribute: values[p.name] for p in CAMERA if p.name in values}
        names = {parameter.name for parameter in CAMERA}
        gaussians = PlainGaussians(**{name: value for name, value in values.items() if name not in names})
        return gaussians, CameraColor(**color).gauged() if color else self.identity

    def loss(self, iteration: int, sample: View) -> ViewLoss:
        config, backend = self.config, self.adam.backend
        gaussians, color = self.parts()
        with self.watch.stage("generate"):
            drawn = gaussians.gaussians(sample.camera, backend, degree=None if iteration > config.sh_from else 0)
        collects = iteration <= config.densify.stop
        loss = picture_loss(
            drawn, sample, color, backend=backend, weights=LOSSES, track_screen=collects, watch=self.watch
        )
        self.last_pass.add(iteration, loss, sample)
        return loss

    def after_step(self, iteration: int, sample: View, loss: ViewLoss, screen_gradient: Tensor | None) -> None:
        if screen_gradient is None:
            return
        config = self.config.densify
        with self.watch.stage("densify"), torch.no_grad():
            self.statistics.add(loss.rendering, screen_gradient)
            if config.is_due(iteration):
                self._densify(prune_large=config.has_reset(iteration))
            if iteration == config.reset_at:
                logits = reset_opacities(self.adam.values["logit_opacities"])
                self.adam.values["logit_opacities"] = logits.detach().clone().contiguous().requires_grad_()
                for moments in (self.adam.first, self.adam.second):
                    moments["logit_opacities"] = torch.zeros_like(logits)

    def _densify(self, *, prune_large: bool) -> None:
        change = densify(
            self.parts()[0],
            self.statistics.mean(),
            config=self.config.densify,
            extent=self.extent,
            prune_large=prune_large,
            generator=self.generator,
        )
        self.adam.replace_rows(change.added.tensors(), keep=change.keep)
        self.spawned, self.pruned = self.spawned + len(change.added), self.pruned + change.removed
        self.statistics = GradientStatistics(len(self.adam.values["means"]), self.adam.backend.device)

    def counts(self) -> tuple[int, int]:
        return 0, len(self.adam.values["means"])
