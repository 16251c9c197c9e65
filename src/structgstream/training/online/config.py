# SPDX-License-Identifier: Apache-2.0
"""Configuration of the frames after the first: the paper's method, and what goes beyond it."""

from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

from structgstream.cameras import NEAR_IN_RIG_RADII
from structgstream.errors import ConfigError
from structgstream.scene.state import PAPER_DYNAMIC, STATE_TABLE, FieldName, ParameterName
from structgstream.training.losses import LossWeights
from structgstream.training.parameters import RoundingConfig


@dataclass(frozen=True)
class MotionConfig:
    """Thresholds of motion selection; not in the paper.

    Pixels are those of pictures of the reference size (``cameras.enlargement``).
    """

    enabled: bool = False
    """Train only dynamic anchors and free Gaussians (paper: False, everything is trained)."""
    residual_threshold: float = 0.0
    """A pixel has also changed if its residual exceeds frame 0's by this (full scale 1). 0: residuals are not used."""
    hysteresis: float = 1.0
    """Factor on the thresholds of pixels and shares for primitives that the last frame changed: below 1, what moves
    stays dynamic. 1: none."""
    occluded_share: float = 0.0
    """An anchor that fewer than ``MIN_VOTES`` views show is trained if at least this share of its nearest shown ones
    is: it lies in or behind what moves. 0: none."""
    picture_scale: float = 0.25
    """Scale of width and height, relative to the reference size, of the pictures on which coverage is computed."""
    rest_every: int = 1
    """Unchanged tiles are rendered only in every n-th iteration of a view. 1: always."""
    tiles_around: int = -1
    """Tiles (16 pixels) farther than this many tiles from one in which something has changed are not drawn, though
    dynamic Gaussians reach them. -1: all are."""

    CHANGE_THRESHOLD: ClassVar[float] = 0.05
    """A pixel has changed if its mean absolute difference to the previous picture over 3 x 3 pixels and the channels
    (full scale 1) exceeds this; above the sensors' noise."""
    REACH_PIXELS: ClassVar[int] = 3
    """Changed pixels are dilated by this many pixels."""
    MIN_CHANGED_PIXELS: ClassVar[float] = 0.3
    """Least number of changed pixels, summed by blending weight, that a primitive covers in a view to get its vote: in
    ``select.select_dynamic`` and, for tracks of groups, in ``groups/tracking.py``, as the two below."""
    MIN_CHANGED_SHARE: ClassVar[float] = 0.3
    """Least share of changed pixels among all that a primitive covers in a view to get its vote."""
    MIN_VOTES: ClassVar[int] = 2
    """Least number of votes of a dynamic primitive: two, because one view may have changed by noise. An anchor that is
    visible in fewer views is occluded, and of frames with fewer cameras everything is trained."""
    MARGIN_PIXELS: ClassVar[int] = 8
    """Tiles within this many pixels of dynamic Gaussians are drawn too, so that these get gradients where they move."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.occluded_share <= 1.0:
            raise ConfigError(f"online.motion.occluded_share is {self.occluded_share:g}; expected a share from 0 to 1.")


@dataclass(frozen=True)
class SceneFlowConfig:
    """Initial displacement of primitives; not in the paper."""

    enabled: bool = False
    """Displace primitives by optical flow (paper: False, everything starts at its last position)."""
    rounds: int = 2
    """1: flow between pictures only; 2: also from the rendering to the pictures, in frames in which much moves fast."""
    views: int = 12
    """Approximate largest number of views in which flow is estimated and missing content is searched for; of more
    views each frame takes every second or third, in turn."""

    FEW_FAST: ClassVar[float] = 0.015
    """Share of the dynamic primitives that move fast (``scene_flow.FAST_SHARE``), above which much does. Up to it these
    may be errors of optical flow: where nothing moves fast they were 0.01 at most."""


@dataclass(frozen=True)
class SpawnRules:
    """Thresholds of one sweep for missing content, by which free Gaussians are spawned and pruned."""

    longer_side: int = 320
    """Pictures are reduced to at most this longer side, pixels."""
    residual_threshold: float = 0.10
    """Residual, 0 to 1, above which a pixel counts as wrong."""
    missing_threshold: float = 0.10
    """Excess of the residual over frame 0's, 0 to 1, above which a pixel counts as missing."""
    pixel_step: int = 2
    """Distance in pixels, across and down, between missing pixels whose rays are swept."""
    planes: int = 48
    """Number of depths of a ray that begins at the default near plane; of one that begins nearer in proportion more."""
    min_supports: int = 2
    """Least number of other views that support a point: there a missing pixel lies at its projection."""
    max_contradictions: float = 0.34
    """Largest share of contradicting views, which would see the point but miss nothing, among those that can judge."""
    max_cost: float = 0.12
    """Largest mean colour difference of the supporting views, 0 to 1."""
    min_hits: int = 4
    """Least number of ray points within 1.8 voxels of a new Gaussian."""
    most: int = 5000
    """Largest number of new Gaussians: more than who walks in needs, since below that number all of it is haze."""
    overflow: Literal["coarser", "none", "small-clusters"] = "coarser"
    """Where there would be more than ``most``: Gaussians in larger voxels, none, or those in the smallest clusters."""
    max_missing_share: float = 0.25
    """If a larger share of the pictures is missing nothing is spawned: the light changed, or a camera moved."""
    size: float = 0.7
    """Standard deviation of a new Gaussian, in units of the distance between neighbouring swept rays."""
    opacity: float = 0.7
    """Of a new Gaussian."""
    outlier_share: float = 0.5
    """A free Gaussian is an outlier in a view if more than this share of its pixels is wrong."""
    outlier_views: int = 2
    """A free Gaussian is removed if it is an outlier in at least this many views and in half of those that show it."""

    MAX_PLANES: ClassVar[int] = 384

    def planes_of(self, near: float) -> int:
        """Number of depths of the rays of a camera with its near plane at ``near`` rig radii. They are even in inverse
        depth, so that their distance, in pixels of disparity, is the same for every near plane."""
        return min(round(self.planes * max(1.0, NEAR_IN_RIG_RADII / near)), self.MAX_PLANES)


@dataclass(frozen=True)
class ThinSpawnConfig:
    """A second sweep for thin, faint content such as a stream of water, in frames in which the first spawns nothing.

    Its rules are finer pictures, every ray, lower thresholds. By them something large would become many small
    Gaussians, which follow it worse than few large ones and cost more.
    """

    enabled: bool = False
    """Spawn thin content by a second sweep."""
    overflow: Literal["coarser", "none", "small-clusters"] = "none"
    """Where there would be more than 150 (``SpawnRules.overflow``). Thin content needs few Gaussians. More candidates
    mean that dynamic anchors are misplaced, as in a throw: new Gaussians in their place follow worse and cost more. A
    group of frames that is fitted separately lacks what earlier frames would have spawned: its first frames spawn what
    lies in small clusters."""

    RULES: ClassVar[SpawnRules] = SpawnRules(
        longer_side=480,
        missing_threshold=0.04,
        pixel_step=1,
        max_contradictions=0.5,
        max_cost=0.2,
        min_hits=3,
        most=150,
        max_missing_share=0.02,
    )
    """Of the pictures 0.0005 lack something where a pitcher pours; more than 0.02 is light that changed."""


@dataclass(frozen=True)
class SpawnConfig:
    """Spawning of free Gaussians from geometry, and pruning by residuals; not in the paper."""

    enabled: bool = False
    """Spawn free Gaussians where content is missing (paper: False, by gradients only)."""
    most: int = 5000
    """Largest number of Gaussians that are spawned in a frame."""
    missing_threshold: float = 0.10
    """Excess of the residual over frame 0's, 0 to 1, above which a pixel counts as missing; thin content needs less in
    proportion. Rate control raises it (``rate_control``, Note [Rate scale])."""
    thin: ThinSpawnConfig = field(default_factory=ThinSpawnConfig)

    RULES: ClassVar[SpawnRules] = SpawnRules()
    """Of the first sweep."""
    BASELINE_CAP_MEDIANS: ClassVar[float] = 1.0
    """Where a picture has changed, frame 0's residual, which was of other content, counts as at most this many medians
    of its view's. In the sweep for thin content all of it counts."""

    @property
    def rules(self) -> SpawnRules:
        """The rules of the first sweep."""
        return replace(self.RULES, most=self.most, missing_threshold=self.missing_threshold)

    @property
    def thin_rules(self) -> SpawnRules:
        """The rules of the second sweep."""
        rules, share = self.thin.RULES, self.missing_threshold / self.RULES.missing_threshold
        return replace(rules, overflow=self.thin.overflow, missing_threshold=share * rules.missing_threshold)


@dataclass(frozen=True)
class SmoothnessConfig:
    """Penalty on motion unlike the neighbours'; not in the paper."""

    weight: float = 0.0
    """Weight in the loss of the mean difference of displacement from the neighbours, pixels (paper: 0, none)."""

    NEIGHBOURS: ClassVar[int] = 8
    """Number of nearest dynamic anchors that an anchor is compared with."""
    FEATURE_BANDWIDTH: ClassVar[float] = 1.0
    """Standard deviation of the Gaussian weight of a neighbour by the root mean square difference of features, in their
    standard deviations. 0: no weight by features."""
    SLACK_PIXELS: ClassVar[float] = 0.25
    """Differences far below this cost in proportion to their square, those far above it to their length."""


@dataclass(frozen=True)
class ExposureConfig:
    """Following the global light; not in the paper."""

    enabled: bool = False
    """Follow the global light (paper: False); needs ``color_mlp`` in the dynamic set, of which only the output biases
    then change."""

    PICTURE_SCALE: ClassVar[float] = 0.25
    """Scale of width and height, relative to the reference size, of the pictures that are compared."""
    SAME_THRESHOLD: ClassVar[float] = 0.03
    """Largest mean difference over the channels (full scale 1), beyond the light followed so far, of a pixel that shows
    the same as in frame 0."""
    MIN_SHARE: ClassVar[float] = 0.2
    """Least share of such pixels, weighted by information (black and white ones little), in a view that counts."""
    MIN_CHANGE: ClassVar[float] = 1 / 256
    """Smallest change of a bias that is followed at first, at most a quarter of an 8-bit level: flicker below it costs
    no bits."""
    MIN_FURTHER_CHANGE: ClassVar[float] = 1 / 1024
    """Smallest change of a bias that is made once the light differs from that of frame 0."""


@dataclass(frozen=True)
class PatchingConfig:
    """Spawning and pruning of free Gaussians."""

    spawn: Literal["gradient", "random", "uniform", "off"] = "gradient"
    """Choice of parents: ``gradient`` (paper), ``random`` (as many, drawn at random), ``uniform`` (the same, with
    children anywhere in the box of the anchors: the paper's ablation), ``off``."""
    iteration: int = 50
    """Iteration after which patching is done, once per frame (paper: 50 of 100); in a frame with more, later in
    proportion."""
    grad_threshold: float = 1e-3
    """The paper's tau_grad (0.001), on the mean view-space gradient in NDC (Note [View-space units])."""
    collect_from: int = 0
    """Iteration of the frame after which gradients are averaged (paper: not stated)."""
    prune_opacity: float | None = 0.005
    """Free Gaussians of less opacity are removed before spawning (paper: 0.005); None: no pruning, the paper's "w/o
    quantity control"."""
    lifetime: Literal["stream", "frame"] = "stream"
    """``stream``: inherited by the next frame (paper: global patching); ``frame``: dropped at its start (I1 to I3)."""
    max_free: int = 1_000_000
    """Largest number of free Gaussians; parents with the largest gradients are taken first (paper: no bound)."""

    COVARIANCE_FACTOR: ClassVar[float] = 2.0
    """Factor on the covariance from which a child's mean is drawn, N(mu, factor * Sigma) (paper: 2)."""
    OPACITY: ClassVar[float] = 0.1
    """Opacity at birth (paper: 0.1)."""


SH_CONSTANT = 0.28209479177387814
"""The spherical harmonic of degree 0, 1 / (2 sqrt(pi)). Adam's steps do not depend on the gradient's scale, so a colour
that is trained as this term's coefficient has a rate this much smaller."""


@dataclass(frozen=True)
class OnlineRates:
    """Learning rates of online frames (values of the paper, section Implementations), in normalised units."""

    final_share: float = 1.0
    """Learning rates of anchors and MLPs decay log-linearly to this share within a frame (paper: 1, constant)."""
    free_color: Literal["rgb", "sh"] = "rgb"
    """What ``FREE_COLORS`` is the rate of: sRGB numbers, or the constant term of spherical harmonics, as in 3DGS, of
    which a step changes the colour by ``SH_CONSTANT``. ``rgb`` is left out of headers."""

    ANCHOR_POSITIONS: ClassVar[float] = 4e-4
    OFFSET_SCALES: ClassVar[float] = 5e-3
    COVARIANCE_MLP: ClassVar[float] = 4e-3
    FREE_MEANS: ClassVar[float] = 2e-4
    FREE_LOG_SCALES: ClassVar[float] = 5e-3
    FREE_QUATS: ClassVar[float] = 1e-3
    FREE_LOGIT_OPACITIES: ClassVar[float] = 5e-2
    FREE_COLORS: ClassVar[float] = 2.5e-3
    BASE_SCALES: ClassVar[float] = 5e-3
    """This and the following are used only if the field is in the dynamic set (not in the paper)."""
    ANCHOR_OFFSETS: ClassVar[float] = 1e-3
    ANCHOR_FEATURES: ClassVar[float] = 2.5e-3
    APPEARANCE: ClassVar[float] = 2e-2
    OPACITY_MLP: ClassVar[float] = 2e-3
    COLOR_MLP: ClassVar[float] = 4e-3


@dataclass(frozen=True)
class OnlineConfig:
    """Configuration of the frames after the first."""

    iterations: int = 100
    """Optimisation steps per frame (paper: 100); fewer where the dynamic part is not in all views."""
    extra_iterations: float = 0.0
    """Further steps of a frame in which much moves fast, as a share of ``iterations``: all of them if 4 % of the
    dynamic primitives do, none below 1.5 %, or without scene flow (not in the paper)."""
    dynamic: frozenset[FieldName] = PAPER_DYNAMIC
    """Fields of the state table that are trained after frame 0 (paper: x_v, l_v, F_Sigma and free 3DGs)."""
    appearance_rank: int = 4
    """Number of principal components along which features change, if ``appearance`` is dynamic (not in the paper)."""
    losses: LossWeights = field(default_factory=LossWeights)
    rates: OnlineRates = field(default_factory=OnlineRates)
    patching: PatchingConfig = field(default_factory=PatchingConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    scene_flow: SceneFlowConfig = field(default_factory=SceneFlowConfig)
    """Initial displacements of primitives; only with ``motion``."""
    spawn: SpawnConfig = field(default_factory=SpawnConfig)
    """Spawning of free Gaussians from geometry, and pruning of outliers; only with ``motion``."""
    smoothness: SmoothnessConfig = field(default_factory=SmoothnessConfig)
    """Penalty on motion unlike the neighbours'."""
    motion_prior: float = 0.0
    """Moving anchors are initially displaced by this share of their last displacement (paper: 0)."""
    mean_of_last: float = 0.0
    """The result is the mean of this share of the iterations, the last ones (paper: 0, the last step)."""
    exposure: ExposureConfig = field(default_factory=ExposureConfig)
    """Following the global light by the output biases of F_c."""
    rounding: RoundingConfig = field(default_factory=RoundingConfig)
    sampling_filter: bool = False
    """Train and compare through the low-pass with which players draw (``scene/sampling.py``, Note [Drawn as it was
    trained]), also where pictures are reduced (paper: no, 0.3 square pixels of each picture)."""

    MANY_FAST: ClassVar[float] = 0.04
    """Share of the dynamic primitives that move fast, from which on all ``extra_iterations`` are run."""

    def __post_init__(self) -> None:
        if self.exposure.enabled and "color_mlp" not in self.dynamic:
            raise ConfigError("online.exposure changes F_c, which is not sent; add color_mlp to online.dynamic.")

    def effort(self, fast_share: float) -> float:
        """Factor on the iterations of a frame in which ``fast_share`` of the dynamic primitives moves fast."""
        few = self.scene_flow.FEW_FAST
        much = (fast_share - few) / (self.MANY_FAST - few)
        return 1.0 + self.extra_iterations * min(max(much, 0.0), 1.0)

    @property
    def trained(self) -> frozenset[FieldName]:
        """The dynamic fields that optimisation changes: F_c, if it follows the light, is not among them."""
        return self.dynamic.difference(["color_mlp"]) if self.exposure.enabled else self.dynamic


def online_rates(config: OnlineConfig, share: float) -> dict[ParameterName, float]:
    """Learning rate of every parameter after ``share`` (0 to 1) of a frame's iterations."""
    falling = config.rates.final_share**share
    rates: dict[ParameterName, float] = {}
    for row in STATE_TABLE:
        for parameter in row.parameters:
            rate = getattr(config.rates, parameter.online_rate.upper()) if parameter.online_rate else 0.0
            rates[parameter.name] = rate if row.granularity == "free" else rate * falling
    if config.rates.free_color == "sh":
        rates["free_colors"] *= SH_CONSTANT
    return rates
