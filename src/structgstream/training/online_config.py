# SPDX-License-Identifier: Apache-2.0
"""Configuration of the frames after the first: the paper's method, and what goes beyond it."""

from dataclasses import dataclass, field

from structgstream.errors import ConfigError
from structgstream.scene.state import PAPER_DYNAMIC, STATE_TABLE, FieldName, ParameterName
from structgstream.training.births import BirthConfig
from structgstream.training.coherence import CoherenceConfig
from structgstream.training.light import LightConfig
from structgstream.training.losses import LossWeights
from structgstream.training.motion import MotionConfig
from structgstream.training.motion_start import MotionStartConfig
from structgstream.training.patching import PatchingConfig
from structgstream.training.rounding import RoundingConfig


@dataclass(frozen=True)
class OnlineRates:
    """Learning rates of online frames (values of the paper, section Implementations), in normalised units."""

    anchor_positions: float = 4e-4
    offset_scales: float = 5e-3
    covariance_mlp: float = 4e-3
    free_means: float = 2e-4
    free_log_scales: float = 5e-3
    free_quats: float = 1e-3
    free_logit_opacities: float = 5e-2
    free_colors: float = 2.5e-3
    base_scales: float = 5e-3
    """This and the following are used only if the field is in the dynamic set (not in the paper)."""
    anchor_offsets: float = 1e-3
    anchor_features: float = 2.5e-3
    appearance: float = 2e-2
    opacity_mlp: float = 2e-3
    color_mlp: float = 4e-3
    final_share: float = 1.0
    """Learning rates of anchors and MLPs decay log-linearly to this share within a frame (paper: 1, constant)."""


@dataclass(frozen=True)
class OnlineConfig:
    """Configuration of the frames after the first."""

    iterations: int = 100
    """Optimisation steps per frame (paper: 100)."""
    dynamic: frozenset[FieldName] = PAPER_DYNAMIC
    """Fields of the state table that are trained after frame 0 (paper: x_v, l_v, F_Sigma and free 3DGs)."""
    appearance_rank: int = 4
    """Number of principal components along which features change, if ``appearance`` is dynamic (not in the paper)."""
    losses: LossWeights = field(default_factory=LossWeights)
    rates: OnlineRates = field(default_factory=OnlineRates)
    patching: PatchingConfig = field(default_factory=PatchingConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    start: MotionStartConfig = field(default_factory=MotionStartConfig)
    """Initial displacements of movers; only with ``motion``."""
    births: BirthConfig = field(default_factory=BirthConfig)
    """Births of free Gaussians from geometry, and removal of outliers; only with ``motion``."""
    coherence: CoherenceConfig = field(default_factory=CoherenceConfig)
    """The price of moving unlike the neighbours."""
    motion_prior: float = 0.0
    """Moving anchors are initially displaced by this share of their last displacement (paper: 0)."""
    mean_of_last: float = 0.0
    """The result is the mean of this share of the iterations, the last ones (paper: 0, the last step)."""
    light: LightConfig = field(default_factory=LightConfig)
    """Following the global light by the output biases of F_c."""
    least_gain: float = 0.0
    """Early stopping (and early patching): when ``iterations`` steps at the present rate would lower the loss by less
    than this share (paper: 0, never)."""
    rounding: RoundingConfig = field(default_factory=RoundingConfig)
    sampling_filter: bool = False
    """Train and compare through the low-pass with which players draw (``scene/sampling.py``, Note [Drawn as it was
    trained]), also where pictures are reduced (paper: no, 0.3 square pixels of each picture)."""

    def __post_init__(self) -> None:
        if self.light.enabled and "color_mlp" not in self.dynamic:
            raise ConfigError("online.light changes F_c, which packets do not carry; add color_mlp to online.dynamic.")

    @property
    def trained(self) -> frozenset[FieldName]:
        """The dynamic fields that optimisation changes: F_c, if it follows the light, is not among them."""
        return self.dynamic.difference(["color_mlp"]) if self.light.enabled else self.dynamic


def online_rates(config: OnlineConfig, share: float) -> dict[ParameterName, float]:
    """Learning rate of every parameter after ``share`` (0 to 1) of a frame's iterations."""
    falling = config.rates.final_share**share
    rates: dict[ParameterName, float] = {}
    for row in STATE_TABLE:
        for parameter in row.parameters:
            rate = getattr(config.rates, parameter.online_rate) if parameter.online_rate else 0.0
            rates[parameter.name] = rate if row.granularity == "free" else rate * falling
    return rates
