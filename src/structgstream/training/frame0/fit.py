# SPDX-License-Identifier: Apache-2.0
"""Frame 0: a static reconstruction with anchors (paper, section Structured 3DGs)."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import ClassVar

import torch
from torch import Tensor

from structgstream.cameras import CameraRig, rig_radius
from structgstream.errors import CaptureError
from structgstream.frames import MultiViewFrame, RovingPicture
from structgstream.kernels.backend import Backend
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene
from structgstream.scene.state import PARAMETERS, ParameterName
from structgstream.training.frame0.densify import Densifier, GrowthConfig
from structgstream.training.frame0.regularizers import (
    DepthDistortionConfig,
    FreeSpaceConfig,
    PerturbationConfig,
    RandomNumbers,
    depth_distortion,
    in_free_space,
    perturbation_at,
)
from structgstream.training.frame0.roving import RovingViews, alternating
from structgstream.training.frame0.seeding import seeded_scene, warm_start
from structgstream.training.losses import InitialLossWeights, SceneLoss, offset_distance, view_loss, with_term
from structgstream.training.optim import Adam, Hooks, LastPass, LearningRate, Schedule, minimize
from structgstream.training.parameters import CAMERA_ROWS, Parameters, detached
from structgstream.training.result import FitResult, StepListener, Stopwatch
from structgstream.training.views import View, coarse_to_fine, training_views


@dataclass(frozen=True)
class InitialRates:
    """Learning rates of frame 0, first and last ones of schedules over ``schedule_iterations`` (Scaffold-GS).

    Positions of anchors are fixed.
    """

    offsets: tuple[float, float] = (0.01, 1e-4)
    """Of O_v, times 1.1 rig radii, as in Scaffold-GS."""
    features: tuple[float, float] = (0.0075, 0.0075)
    """Of f_v."""
    scales: tuple[float, float] = (0.007, 0.007)
    """Of both scales of an anchor, in log space."""
    opacity_mlp: tuple[float, float] = (0.002, 2e-5)
    """Of F_alpha."""
    covariance_mlp: tuple[float, float] = (0.004, 0.004)
    """Of F_Sigma."""
    color_mlp: tuple[float, float] = (0.008, 5e-5)
    """Of F_c."""
    camera_color: tuple[float, float] = (0.002, 1e-4)
    """Of gains and biases; unused without ``camera_color``."""


@dataclass(frozen=True)
class InitialConfig:
    """Configuration of frame 0."""

    iterations: int = 4000
    """Optimisation steps (paper: 4000)."""
    voxel_size: float = 0.005
    """The paper's eps (0.005), in units of the normalised scene."""
    seed_voxels: int = 1
    """Initial points are reduced to one anchor per cell of this many voxels along each axis (paper: 1); growing adds
    anchors between them."""
    offsets_per_anchor: int = 5
    """The paper's k (5): structured Gaussians per anchor."""
    distance_input: bool = True
    """Whether the distance to the camera is an input of the MLPs (paper: yes; Scaffold-GS: no)."""
    camera_color: bool = False
    """Train a gain and a bias per training camera and channel (Note [Colour gauge]), for rigs with unequal exposures
    (paper: no)."""
    coarse_iterations: int = 0
    """Number of first iterations on pictures reduced by ``COARSE_SCALE``, which cost less (paper: 0)."""
    medium_iterations: int = 0
    """Number of iterations after these on pictures reduced by ``MEDIUM_SCALE`` (paper: 0)."""
    schedule_iterations: int = 30_000
    """Length of the learning-rate schedules (Scaffold-GS: 30,000, of which the paper runs 4,000)."""
    random_background: bool = False
    """Random background colour in every iteration (``training/frame0/seeding.py``, Note [Honest coverage]; paper:
    black)."""
    all_drawn: bool = False
    """Initialise F_alpha so that all of an anchor's Gaussians are drawn (``training/frame0/seeding.py``, Note [Dead
    outputs]; Scaffold-GS: no, about half are)."""
    sampling_filter: bool = False
    """Train through the low-pass with which players draw (``scene/sampling.py``, Note [Drawn as it was trained]), also
    on reduced pictures (paper: no, 0.3 square pixels of each picture)."""
    perturbation: PerturbationConfig = field(default_factory=PerturbationConfig)
    depth_distortion: DepthDistortionConfig = field(default_factory=DepthDistortionConfig)
    floaters: FreeSpaceConfig = field(default_factory=FreeSpaceConfig)
    losses: InitialLossWeights = InitialLossWeights()
    rates: InitialRates = field(default_factory=InitialRates)
    growth: GrowthConfig = field(default_factory=GrowthConfig)

    FEATURE_WIDTH: ClassVar[int] = 32
    """Length of f_v (Scaffold-GS: 32)."""
    HIDDEN_WIDTH: ClassVar[int] = 32
    """Width of the MLPs' hidden layer (Scaffold-GS: 32)."""
    COARSE_SCALE: ClassVar[float] = 0.5
    """Scale of width and height of the pictures in these iterations."""
    MEDIUM_SCALE: ClassVar[float] = 0.7
    """Scale of width and height of the pictures in these iterations."""

    def stages(self, *, done: int = 0) -> list[tuple[int, float]]:
        """Number and scale of the iterations on reduced pictures that are left after the first ``done``."""
        coarse = max(self.coarse_iterations - done, 0)
        medium = max(self.coarse_iterations + self.medium_iterations - max(done, self.coarse_iterations), 0)
        return [(coarse, self.COARSE_SCALE), (medium, self.MEDIUM_SCALE)]


def rates_at(iteration: int, config: InitialConfig, *, extent: float) -> dict[ParameterName, float]:
    """Learning rate of every parameter of frame 0 after ``iteration`` steps; ``extent``: 1.1 rig radii, scene units."""
    share = iteration / config.schedule_iterations
    units = {"offsets": extent}
    return {
        parameter.name: LearningRate(*getattr(config.rates, parameter.first_rate)).at(share)
        * units.get(parameter.first_rate, 1.0)
        for parameter in PARAMETERS
        if parameter.first_rate
    }


def rig_extent(rig: CameraRig) -> float:
    """1.1 rig radii: the unit of Scaffold-GS's offset rate."""
    return 1.1 * rig_radius(rig)


@dataclass
class _FirstFrameHooks(Hooks[View, SceneLoss]):
    """Iterations of frame 0: perturbation of the drawn Gaussians, growing and pruning of anchors."""

    config: InitialConfig
    backend: Backend
    template: Scene
    parameters: Parameters
    adam: Adam[ParameterName]
    densifier: Densifier
    generator: torch.Generator
    numbers: RandomNumbers
    watch: Stopwatch
    last_pass: LastPass
    roving: RovingViews

    @property
    def scene(self) -> Scene:
        """The present scene; differentiable."""
        return self.parameters.scene(self.template)

    def loss(self, iteration: int, sample: View) -> SceneLoss:
        config, generator = self.config, self.generator
        scene, roving = self.scene, self.roving.has(sample)
        scene, view = self.roving.applied(scene, sample) if roving else (scene, sample)
        # The result depends on the order of random draws.
        loss = view_loss(
            scene,
            view,
            backend=self.backend,
            weights=config.losses,
            track_screen=self.densifier.collects(iteration),
            watch=self.watch,
            perturbation=perturbation_at(iteration, config.iterations, config.perturbation, self.numbers),
            background=torch.rand(3, generator=generator).to(self.backend.device) if config.random_background else None,
        )
        if config.losses.offset_distance:
            with self.watch.stage("loss"):
                distance = offset_distance(
                    scene.anchors, voxel_size=config.voxel_size, weights=config.losses, backend=self.backend
                )
                loss = with_term(loss, "offset_distance", distance, weight=config.losses.offset_distance)
        if weight := config.depth_distortion.weight_at(iteration, config.iterations):
            with self.watch.stage("rasterise"):
                spread = depth_distortion(
                    loss.unperturbed, sample.camera, scale=config.depth_distortion.SCALE, backend=self.backend
                )
                loss = with_term(loss, "depth_distortion", spread, weight=weight)
        if roving:
            self.roving.fit_gains(sample, loss.rendering, share=iteration / config.iterations)
        else:
            self.last_pass.add(iteration, loss, sample)
        return loss

    def after_step(self, iteration: int, sample: View, loss: SceneLoss, screen_gradient: Tensor | None) -> None:
        densifier = self.densifier
        if screen_gradient is not None:
            with self.watch.stage("densify"), torch.no_grad():
                densifier.gradients.add(loss.rendering, screen_gradient)
                densifier.opacities.add(loss.structured)
                if densifier.is_due(iteration):
                    densifier.apply(self.scene, self.adam, self.generator, iteration=iteration)

    def counts(self) -> tuple[int, int]:
        return len(self.adam.values["anchor_positions"]), 0


def fit_first_frame(
    frame: MultiViewFrame,
    rig: CameraRig,
    points: Tensor,
    *,
    config: InitialConfig,
    backend: Backend,
    seed: int,
    on_step: StepListener | None = None,
    roving: Sequence[RovingPicture] = (),
) -> FitResult[Scene]:
    """Reconstruct frame 0 from its training views.

    Args:
        frame: the pictures; only those of ``rig.training`` are read. The colour of an absent camera stays neutral.
        rig: cameras in normalised units.
        points: ``[P, 3]`` initial points in normalised units.
        config: of frame 0.
        backend: the compute back-end.
        seed: of all random numbers.
        on_step: called after every iteration.
        roving: pictures of a roving camera, in normalised units; every second iteration takes one of them.

    Raises:
        CaptureError: too few points, or no anchor is left.
    """
    generator = torch.Generator().manual_seed(seed)
    template = seeded_scene(
        points,
        cameras=len(rig.training),
        voxel_size=config.voxel_size * config.seed_voxels,
        offsets_per_anchor=config.offsets_per_anchor,
        feature_width=config.FEATURE_WIDTH,
        hidden_width=config.HIDDEN_WIDTH,
        distance_input=config.distance_input,
        device=backend.device,
        generator=generator,
        all_drawn=config.all_drawn,
    )
    result = _fit(
        frame, rig, template, config=config, backend=backend, generator=generator, on_step=on_step, roving=roving
    )
    if not len(result.scene.anchors):
        raise CaptureError(
            f"Frame {frame.index} lost all of its {len(template.anchors)} anchors in training, so its poses or initial "
            "points do not fit its pictures; look at structgstream prepare --check, or give another --seed."
        )
    return result


def fit_first_frame_again(
    frame: MultiViewFrame,
    rig: CameraRig,
    scene: Scene,
    *,
    iterations: int,
    config: InitialConfig,
    backend: Backend,
    seed: int,
    on_step: StepListener | None = None,
) -> FitResult[Scene]:
    """Reconstruct a frame as frame 0 is, from the scene of the frame before it (``training/frame0/seeding.py``).

    The iterations are the last ones of frame 0's schedule: learning rates, the growing of anchors and the scale of the
    pictures are as they are there.

    Args:
        frame: the pictures; only those of ``rig.training`` are read.
        rig: cameras in normalised units.
        scene: of the frame before, decoded.
        iterations: how many, at most those of ``config``.
        config: of frame 0.
        backend: the compute back-end.
        seed: of all random numbers.
        on_step: called after every iteration.
    """
    generator = torch.Generator().manual_seed(seed)
    template = warm_start(scene, cell=config.voxel_size * config.seed_voxels)
    done = max(config.iterations - iterations, 0)
    # The share that may be added beyond the bound is one of the seeds, not of each period's scene.
    config = replace(config, growth=replace(config.growth, min_growth=0.0))
    return _fit(frame, rig, template, config=config, backend=backend, generator=generator, done=done, on_step=on_step)


def _fit(
    frame: MultiViewFrame,
    rig: CameraRig,
    template: Scene,
    *,
    config: InitialConfig,
    backend: Backend,
    generator: torch.Generator,
    done: int = 0,
    on_step: StepListener | None = None,
    roving: Sequence[RovingPicture] = (),
) -> FitResult[Scene]:
    """Train ``template`` in the iterations of frame 0 after the first ``done``."""
    watch = Stopwatch()
    template = replace(template, sampling=RigSampling.of(rig) if config.sampling_filter else None)
    views, extent = training_views(frame, rig, backend.device), rig_extent(rig)
    parameters = Parameters.of(template, trained=_trained(config))
    adam = Adam(backend, parameters.values)
    growth = config.growth.for_pictures(median(view.enlargement for view in views))
    densifier = Densifier.of(template, config=growth, iterations=config.iterations, voxel_size=config.voxel_size)
    walked = RovingViews.of(roving, first=len(rig.training), fits_gains=config.camera_color, device=backend.device)
    last_pass = LastPass(config.iterations - 2 * len(views) * (2 if roving else 1) + 1)
    numbers = RandomNumbers(generator, backend.device)
    hooks = _FirstFrameHooks(
        config,
        backend,
        template,
        parameters,
        adam,
        densifier,
        generator,
        numbers,
        watch,
        last_pass,
        walked,
    )
    samples = coarse_to_fine(views, config.stages(done=done), generator=generator)
    if roving:
        samples = alternating(views, walked.views, config.stages(done=done), generator=generator)
    schedule = Schedule(config.iterations, lambda iteration: rates_at(iteration, config, extent=extent), done=done)
    iterations = minimize(adam, samples, schedule, hooks, watch=watch, on_step=on_step)
    scene, counts = detached(hooks.scene), {}
    if config.floaters.enabled:
        with watch.stage("densify"):
            floating = in_free_space(scene, (*views, *walked.views), config=config.floaters, backend=backend)
            scene = replace(scene, anchors=scene.anchors.select(~floating))
            counts["floaters"] = int(floating.sum())
    return FitResult(
        scene=scene,
        iterations=iterations,
        train_psnr=last_pass.psnr,
        grown=densifier.grown,
        removed=densifier.pruned + sum(counts.values()),
        counts=counts,
        seconds=watch.seconds,
        losses=last_pass.terms,
    )


def _trained(config: InitialConfig) -> frozenset[ParameterName]:
    """The trained parameters, without the camera colour if it is off."""
    trained: set[ParameterName] = {name for name, rate in rates_at(0, config, extent=1.0).items() if rate > 0.0}
    return frozenset(trained if config.camera_color else trained.difference(CAMERA_ROWS))
