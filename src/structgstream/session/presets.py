# SPDX-License-Identifier: Apache-2.0
"""Configurations as values. Paper mode is a preset; the paper's ablations are edits of a preset."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from types import UnionType
from typing import Any, ClassVar, Literal, Union, get_args, get_origin, get_type_hints

from structgstream.cameras import CameraRig
from structgstream.data.denoising import DenoisingConfig
from structgstream.data.points import PointsConfig
from structgstream.errors import ConfigError
from structgstream.session.periods import PeriodConfig
from structgstream.session.rate_control import RateConfig
from structgstream.training.frame0.densify import GrowthConfig
from structgstream.training.frame0.fit import InitialConfig, InitialRates
from structgstream.training.frame0.regularizers import DepthDistortionConfig, FreeSpaceConfig, PerturbationConfig
from structgstream.training.frame0.seeding import EnvironmentConfig
from structgstream.training.online.config import (
    ExposureConfig,
    MotionConfig,
    OnlineConfig,
    OnlineRates,
    PatchingConfig,
    SceneFlowConfig,
    SmoothnessConfig,
    SpawnConfig,
    ThinSpawnConfig,
)
from structgstream.training.parameters import RoundingConfig

SIGNED = frozenset({"quality", "tiles_around"})
"""Fields that may be negative."""
SHARES = frozenset({"mean_of_last", "motion_prior", "picture_scale", "dropped_share", "occluded_share"})
"""Fields that are at most 1."""
POSITIVE = frozenset({"picture_scale", "key_interval_seconds", "target_mbits"})
"""Fields that must not be 0."""
_KINDS: Mapping[Any, tuple[type, ...]] = {int: (int,), float: (int, float), bool: (bool,)}


def plain_value(value: Any) -> Any:
    """``value``, of the dictionary of a configuration, as plain JSON values."""
    if isinstance(value, dict):
        return {key: plain_value(item) for key, item in value.items()}
    if isinstance(value, frozenset | set):
        return sorted(value)
    return [plain_value(item) for item in value] if isinstance(value, list | tuple) else value


def check_numbers(config: Any, path: str = "") -> None:
    """Check every number of a configuration and of those in it: finite, not negative, and within its bounds.

    Raises:
        ConfigError: naming the field by its path.
    """
    hints = get_type_hints(type(config))
    for item in fields(config):
        value, where = getattr(config, item.name), f"{path}{item.name}"
        if is_dataclass(value):
            check_numbers(value, f"{where}.")
        elif isinstance(value, tuple):
            for number in value:
                _check_number(number, item.name, where)
        elif hints[item.name] in _KINDS and type(value) not in _KINDS[hints[item.name]]:
            expected = {int: "a whole number", float: "a number", bool: "true or false"}[hints[item.name]]
            raise ConfigError(f"{where} is {value!r}; expected {expected}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            _check_number(value, item.name, where)


def _check_number(value: float, name: str, where: str) -> None:
    shares, positive = name in SHARES, name in POSITIVE
    least, most = (-math.inf if name in SIGNED else 0.0), (1.0 if shares else math.inf)
    if not math.isfinite(value) or not least <= value <= most or (positive and value == 0):
        start = "more than 0" if positive else "a finite number" if name in SIGNED else "0 or more"
        raise ConfigError(f"{where} is {value!r}; expected {start}{', and at most 1' if shares else ''}.")


def read_value(kind: Any, value: Any, path: str = "") -> Any:
    """``value``, plain JSON, as a ``kind``: a dataclass, a container, or what JSON has itself; ``path`` is where it is.

    Raises:
        ConfigError: a dataclass lacks the field, or has no such value.
        TypeError, ValueError, AttributeError: it is of another kind.
    """
    if isinstance(kind, type) and is_dataclass(kind):
        hints = get_type_hints(kind)
        if unknown := [name for name, _ in value.items() if name not in hints]:
            raise ConfigError(
                f"The header's configuration has the field {path}{unknown[0]}, which this version of structgstream "
                "does not have; continue the stream with the version that began it."
            )
        return kind(**{name: read_value(hints[name], item, f"{path}{name}.") for name, item in value.items()})
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        (kind,) = (of for of in arguments if of is not type(None))
        return None if value is None else read_value(kind, value, path)
    if origin in (tuple, frozenset):
        if not isinstance(value, list):
            raise TypeError(value)
        return origin(read_value(arguments[0], item) for item in value)
    if origin is Literal and value not in arguments:
        raise ValueError(value)
    return value


MAX_QUALITY = 6.0  # steps 64 times as small, or as large


@dataclass(frozen=True)
class StreamConfig:
    """Everything that determines a reconstruction, apart from the capture and the machine."""

    initial: InitialConfig = field(default_factory=InitialConfig)
    online: OnlineConfig = field(default_factory=OnlineConfig)
    points: PointsConfig = field(default_factory=PointsConfig)
    """Initial points from frame 0, for captures without points."""
    denoising: DenoisingConfig = field(default_factory=DenoisingConfig)
    """Means over frames of what stands still in frame 0."""
    environment: EnvironmentConfig = field(default_factory=EnvironmentConfig)
    """Background of unobserved directions."""
    key_interval_seconds: float = 1.0
    """Interval of key packets, at which a viewer can start, in seconds of media time."""
    codec: Literal["raw", "compact"] = "raw"
    """Coding of frames: ``raw`` float32, or ``compact``, quantized (``online.rounding``) and entropy coded."""
    rate: RateConfig = field(default_factory=RateConfig)
    """Rate control; only with the codec ``compact``."""
    period: PeriodConfig = field(default_factory=PeriodConfig)
    """When the stream goes on with another header; while off, it is left out of headers."""
    seed: int = 0
    """Random seed, from 0 on."""

    NORMALISED_RADIUS: ClassVar[float] = 1.0
    """Largest distance of a training camera to their mean in normalised units, to which learning rates and voxel sizes
    refer (paper: not stated)."""

    def __post_init__(self) -> None:
        check_numbers(self)

    def key_interval(self, fps: float) -> int:
        """Frames from one key packet to the next; at least 2 with a target rate, as that is met by delta packets."""
        return max(1 if self.rate.target_mbits is None else 2, round(fps * self.key_interval_seconds))


def to_json(config: StreamConfig) -> dict[str, Any]:
    """The resolved configuration as plain JSON values: what a stream's header stores."""
    found = plain_value(asdict(config))
    if found.get("period") == asdict(PeriodConfig()):
        del found["period"]
    rates = found.get("online", {}).get("rates", {})
    if rates.get("free_color") == "rgb":
        del rates["free_color"]
    return found


def from_json(values: Mapping[str, Any]) -> StreamConfig:
    """The configuration that :func:`to_json` turned into ``values``, such as a stream's header has.

    Fields that ``values`` lacks have their defaults.

    Raises:
        ConfigError: there is a field that this version does not have, or a value that no field can have.
    """
    try:
        return read_value(StreamConfig, values)
    except (TypeError, ValueError, AttributeError) as error:
        raise ConfigError("The header's configuration has a value of another kind than its field.") from error


def completed(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """``values`` with the defaults of the fields that they lack; another method's as they are."""
    try:
        return to_json(from_json(values)) if values else values
    except ConfigError:
        return values


def preset_named(name: str) -> StreamConfig:
    """The configuration of a preset. Raises ConfigError if there is no such preset."""
    if name not in PRESETS:
        raise ConfigError(f"there is no preset {name!r}; there are {', '.join(PRESETS)}.")
    return PRESETS[name]


def with_budget(config: StreamConfig, *, name: str | None, quality: float | None, mbits: float | None) -> StreamConfig:
    """``config`` with another ``quality`` (``RoundingConfig.quality``) and a target rate of ``mbits`` Mbit/s, if they
    are given. Raises ConfigError if the codec is not ``compact``, or a value is out of range."""
    if quality is None and mbits is None:
        return config
    if config.codec != "compact":
        option = "--mbits" if quality is None else "--quality"
        made = "this configuration" if name is None else f"the preset {name!r}"
        raise ConfigError(
            f"{option} is for streams with the codec compact; {made} makes one with the codec {config.codec}. "
            "Add --preset compact."
        )
    if quality is not None:
        if not abs(quality) <= MAX_QUALITY:
            raise ConfigError(
                f"--quality {quality:g} is not one of {-MAX_QUALITY:g} to {MAX_QUALITY:g}: 0 is the preset's own, "
                "and 1 more makes every step half as large."
            )
        rounding = replace(config.online.rounding, quality=quality)
        config = replace(config, online=replace(config.online, rounding=rounding))
    if mbits is not None:
        if not 0 < mbits < math.inf:
            raise ConfigError(f"--mbits {mbits:g} is no rate; it is in megabits a second, such as --mbits 5.")
        config = replace(config, rate=replace(config.rate, target_mbits=mbits))
    return config


def with_decay(rates: InitialRates, share: float) -> InitialRates:
    """The same initial learning rates, each decaying to ``share`` of itself over the schedule."""
    return InitialRates(**{name: (first, first * share) for name, (first, _) in vars(rates).items()})


PAPER = StreamConfig()
"""The paper's constants with the readings of docs/method.md, for rigs of equal exposure.

Section Implementations gives one set of them for all data sets; what differs is :data:`PAPER_DATA`."""


@dataclass(frozen=True)
class PaperData:
    """The paper's properties of one data set (section Datasets), which are all that differs between its experiments."""

    width: int  # of the pictures that are trained on and scored, pixels, after reduction
    height: int  # the same
    cameras: int  # number of cameras of the rig
    held_out: int | None  # number of held-out cameras; None if the paper does not state it
    held_out_camera: str  # the camera that published results hold out
    scale: float = 1.0  # of the pictures relative to the stored ones; --scale of reconstruct


PAPER_DATA: Mapping[str, PaperData] = {
    "paper-n3dv": PaperData(1352, 1014, cameras=21, held_out=None, held_out_camera="cam00", scale=0.5),
    "paper-meetroom": PaperData(1280, 720, cameras=13, held_out=1, held_out_camera="cam_0"),
    "paper-immersive": PaperData(1280, 960, cameras=46, held_out=1, held_out_camera="camera_0001", scale=0.5),
}
"""By the preset named after the data set. They are properties of the capture, so they are not in the configuration."""


def departures(preset: str, rig: CameraRig) -> list[str]:
    """Differences of a rig to that of the paper's data set, a few words each; empty for presets of no data set."""
    data = PAPER_DATA.get(preset)
    if data is None:
        return []
    found = []
    sizes = sorted({(rig[name].width, rig[name].height) for name in rig})
    if sizes != [(data.width, data.height)]:
        theirs = ", ".join(f"{width}x{height}" for width, height in sizes)
        reduced = "" if data.scale == 1 else f" (--scale {data.scale:g} of the stored)"
        found.append(f"pictures of {theirs} instead of {data.width}x{data.height}{reduced}")
    if len(rig.cameras) != data.cameras:
        found.append(f"{len(rig.cameras)} cameras instead of {data.cameras}")
    if data.held_out is not None and len(rig.testing) != data.held_out:
        found.append(f"{len(rig.testing)} held out instead of {data.held_out}")
    if data.held_out_camera in rig.training:
        found.append(f"{data.held_out_camera} trained on instead of held out")
    return found


RIG = StreamConfig(
    initial=InitialConfig(
        iterations=4000,
        voxel_size=0.0067,
        schedule_iterations=4000,
        camera_color=True,
        coarse_iterations=2500,
        rates=with_decay(InitialRates(), 0.05),
        growth=GrowthConfig(collect_from=500, start=800, stop=3400, max_anchors=120_000),
    ),
    online=OnlineConfig(patching=PatchingConfig(max_free=100_000)),
)
"""The paper's online method on any rig: exposures are equalised, frame 0's learning rates decay and it starts on
reduced pictures, and the number of free Gaussians, unbounded in the paper, is bounded."""

MOTION = replace(RIG, online=replace(RIG.online, motion=MotionConfig(enabled=True)))
"""As RIG, but only dynamic primitives are trained. F_Sigma is fixed, because static anchors depend on it."""

COMPACT = replace(
    MOTION,
    initial=replace(
        MOTION.initial,
        iterations=2600,
        schedule_iterations=2600,
        coarse_iterations=1700,
        medium_iterations=500,
        seed_voxels=3,
        offsets_per_anchor=3,
        all_drawn=True,
        rates=replace(
            MOTION.initial.rates,
            offsets=(0.02, 0.001),
            features=(0.02, 0.001),
            scales=(0.021, 0.001),
            opacity_mlp=(0.004, 2e-4),
        ),
        growth=GrowthConfig(
            collect_from=110,
            start=200,
            stop=2200,
            grad_threshold=6e-5,
            eligible_count=30,
            prune_visits=60,
            max_anchors=50_000,
            min_growth=0.25,
            room_until=1600,
        ),
        losses=replace(MOTION.initial.losses, l1=0.6, ssim=0.45, offset_distance=0.0),
        perturbation=PerturbationConfig(dropped_share=0.2, noise_scales=0.5),
        depth_distortion=DepthDistortionConfig(weight=0.05),
        floaters=FreeSpaceConfig(enabled=True),
        random_background=True,
        sampling_filter=True,
    ),
    denoising=DenoisingConfig(frames=8),
    environment=EnvironmentConfig(enabled=True),
    codec="compact",
    online=replace(
        MOTION.online,
        iterations=128,
        extra_iterations=1.0,
        mean_of_last=0.25,
        rates=OnlineRates(final_share=0.4),
        patching=replace(MOTION.online.patching, spawn="off", iteration=46),
        dynamic=MOTION.online.dynamic.difference(["covariance_mlp"]).union(["base_scales", "appearance", "color_mlp"]),
        exposure=ExposureConfig(enabled=True),
        motion=replace(
            MOTION.online.motion,
            hysteresis=0.5,
            occluded_share=0.4,
            residual_threshold=0.05,
            picture_scale=0.5,
            tiles_around=1,
            rest_every=3,
        ),
        scene_flow=SceneFlowConfig(enabled=True),
        spawn=SpawnConfig(enabled=True, thin=ThinSpawnConfig(enabled=True)),
        motion_prior=0.7,
        sampling_filter=True,
        smoothness=SmoothnessConfig(weight=8e-4),
        rounding=RoundingConfig(free_priced=True),
    ),
)
"""As MOTION, with small packets: dynamic fields are quantized and predicted from the previous frame, and appearance is
dynamic. Frame 0 starts from few seeds and grows where gradients are large, with dropout and perturbation against
overfitting, the depth regulariser, an environment, and means of eight frames where they stand still."""

FINE = replace(
    COMPACT,
    initial=replace(
        COMPACT.initial,
        iterations=5200,
        schedule_iterations=5200,
        coarse_iterations=3400,
        medium_iterations=1000,
        growth=replace(COMPACT.initial.growth, stop=4400, room_until=3200),
    ),
    online=replace(COMPACT.online, iterations=256),
)
"""As COMPACT with twice the iterations, for a GPU or for patience."""

FAST = replace(
    COMPACT,
    initial=replace(
        COMPACT.initial,
        iterations=1200,
        schedule_iterations=1200,
        coarse_iterations=800,
        medium_iterations=220,
        growth=replace(
            COMPACT.initial.growth,
            collect_from=80,
            start=150,
            stop=1000,
            room_until=720,
            eligible_count=20,
            prune_visits=40,
        ),
    ),
)
"""As COMPACT with a shorter frame 0, for a first result in minutes on a laptop."""

TINY = replace(
    FAST,
    initial=replace(
        FAST.initial,
        iterations=60,
        schedule_iterations=60,
        coarse_iterations=30,
        medium_iterations=10,
        growth=GrowthConfig(collect_from=10, start=20, stop=50, interval=20, eligible_count=2, prune_visits=4),
    ),
    online=replace(FAST.online, iterations=10, patching=replace(FAST.online.patching, iteration=5)),
)
"""As FAST with few iterations, for tests; low quality."""

PRESETS: dict[str, StreamConfig] = {
    "paper-n3dv": PAPER,
    "paper-meetroom": PAPER,
    "paper-immersive": PAPER,
    "rig": RIG,
    "motion": MOTION,
    "compact": COMPACT,
    "fine": FINE,
    "fast": FAST,
    "tiny": TINY,
}
DEFAULT_PRESET = "compact"
PAPER_METHOD_PRESET = "rig"
"""The preset that the paper's ablations edit, and that is compared with other methods."""
DEMO_PRESET = "fast"
