# SPDX-License-Identifier: Apache-2.0
"""Protocols of a pipeline: a method that fits frames, and a codec that stores them.

Struct-GStream with its two codecs is a pipeline (``struct_gstream.py``); another method would be another pipeline.
``loop.py`` runs any of them.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import torch
from torch import Tensor

from structgstream.cameras import CameraRig, Similarity
from structgstream.codec.container.records import Period
from structgstream.codec.contents import PacketInfo
from structgstream.codec.packets import Packet, PacketKind, PacketSink, StreamHeader
from structgstream.codec.scene_coder import Encoded
from structgstream.data.denoising import DenoisingConfig
from structgstream.data.points import PointsConfig
from structgstream.frames import MultiViewFrame, RovingPicture
from structgstream.kernels.backend import Backend
from structgstream.scene.render import Drawable
from structgstream.session.periods import PeriodConfig
from structgstream.session.rate_control import RateConfig
from structgstream.training.online.preprocess import FramePictures
from structgstream.training.result import FitResult, StepListener
from structgstream.training.views import View

State = TypeVar("State", bound=Drawable)
"""A decoded frame. Its length, if it has one, is its number of Gaussians."""
State_co = TypeVar("State_co", bound=Drawable, covariant=True)
Memory = TypeVar("Memory")
"""Data of frame 0 that only the encoder stores; a receiver does not have it."""


@dataclass(frozen=True)
class FrameTask:
    """Input of a method for one frame, in normalised units."""

    frame: MultiViewFrame  # pictures and time of the frame
    pictures: FramePictures  # pictures of the training cameras, preprocessed by Method.observe
    rig: CameraRig  # all cameras; held-out ones are not used
    points: Callable[[], Tensor]  # computes initial points [P, 3] of the frame, which may take long
    backend: Backend  # the compute back-end
    seed: int  # seed of all random numbers, so that a frame can be repeated separately
    steps: Mapping[str, float] = field(default_factory=dict)  # the codec's quantization steps by name; empty in frame 0
    rate_scale: float = 1.0  # factor of the rate control (rate_control, Note [Rate scale])
    roving: Callable[[], Sequence[RovingPicture]] = tuple  # reads pictures of a roving camera; none after frame 0
    begins: str | None = None  # why the frame begins another period, in a few words (periods); None if it does not
    on_step: StepListener | None = None  # called after every optimisation step

    @property
    def remarks(self) -> dict[str, Any]:
        """What ``FrameReport`` states of its pictures; a training camera with a blank one is absent, too."""
        there = {*self.frame.showing(self.rig.training), *self.frame.present(self.rig.testing)}
        absent = tuple(name for name in self.rig if name not in there)
        return {"absent": absent, "begins": self.begins, "mean_of": self.frame.mean_of}


EQUAL_INTERVALS = 0.25
"""Intervals between frames that differ by at most this share count as equal, because time stamps jitter."""
MAX_INTERVALS = 3.0
"""Upper bound of the intervals over which motion is extrapolated after a gap."""


@dataclass(frozen=True)
class Past(Generic[State, Memory]):
    """The state from which a frame is fitted."""

    state: State  # the previous decoded frame (codec.scene_coder, Note [Closed loop])
    memory: Memory  # see Method.prepare
    # the decoded frame before that, if the method needs it and it is of the same period. Frames that show nothing,
    # whose scene is that of the frame before them, do not count for either.
    before_previous: State | None = None
    # presentation times of before_previous and state; None where one of them is unknown
    seconds: tuple[float, float] | None = None

    def intervals(self, pts_seconds: float) -> float:
        """The time from ``state`` to a frame, as a multiple of the time from ``before_previous`` to ``state``.

        Exactly 1 if they are nearly equal, and without ``seconds``; at most :data:`MAX_INTERVALS`.
        """
        if self.seconds is None or self.seconds[1] <= self.seconds[0]:
            return 1.0
        earlier, state = self.seconds
        found = (pts_seconds - state) / (state - earlier)
        return 1.0 if abs(found - 1.0) <= EQUAL_INTERVALS else min(found, MAX_INTERVALS)


class Method(Protocol[State, Memory]):
    """Fits frames. A frame depends only on its task and its past, so that a resumed stream is identical."""

    @property
    def needs_before(self) -> bool:
        """Whether :meth:`observe` needs the pictures of the previous frame."""
        ...

    @property
    def needs_before_previous(self) -> bool:
        """Whether a frame depends on the two decoded frames before it, instead of one."""
        ...

    def observe(
        self, frame: MultiViewFrame, before: Sequence[View] | None, *, rig: CameraRig, backend: Backend
    ) -> FramePictures:
        """Preprocesses pictures independently of the scene, with the views ``before``; called in a thread while the
        previous frame is fitted."""
        ...

    def first(self, task: FrameTask) -> FitResult[State]:
        """Fit frame 0."""
        ...

    def prepare(self, state: State, task: Callable[[], FrameTask]) -> Memory:
        """The data of a period's first decoded frame that later frames need. Calls ``task`` if pictures are used."""
        ...

    def next(self, past: Past[State, Memory], task: FrameTask) -> FitResult[State]:
        """Fit a later frame; one that ``begins`` a period is fitted like frame 0, with static fields of its own."""
        ...


@dataclass(frozen=True)
class StreamFacts:
    """Facts of a run for the header; a run that resumes the stream must have the same ones."""

    codec: str  # name of the codec
    rig: CameraRig  # every camera, in the capture's own units
    similarity: Similarity  # from the capture's units to the scene's
    fps: float  # frames per second of the media
    config: Mapping[str, Any]  # the resolved configuration, as plain JSON values
    metadata: Mapping[str, Any]  # capture name, start frame and the like, as plain JSON values


class StoredStream(Protocol[State_co]):
    """The existing frames of a file, such as a ``StreamReader``."""

    @property
    def header(self) -> StreamHeader: ...

    @property
    def packets(self) -> Sequence[PacketInfo]: ...

    @property
    def complete(self) -> bool: ...

    def __len__(self) -> int: ...

    def header_of(self, index: int) -> StreamHeader:
        """The header of the period of frame ``index``."""
        ...

    def period(self, index: int) -> Period:
        """The period of frame ``index``."""
        ...

    def group(self, index: int) -> Iterator[Packet]:
        """The packets that frame ``index`` needs, from a key packet to its own."""
        ...

    def scene(self, index: int) -> State_co:
        """The decoded frame ``index``, on the CPU."""
        ...


class FrameCoder(Protocol[State]):
    """Encodes and decodes the frames of one stream in order, such as a ``SceneEncoder``."""

    def encode(self, state: State, /, *, index: int, pts_seconds: float, kind: PacketKind) -> Encoded[State]:
        """The packet of a frame, and its reconstruction."""
        ...

    def replay(self, packet: Packet) -> State:
        """Decode an existing packet, and continue after it."""
        ...


class StreamCodec(Protocol[State]):
    """The codec of a stream: its file, header and frame coder."""

    @property
    def name(self) -> str:
        """The value of the header's ``codec``."""
        ...

    def key_interval(self, fps: float) -> int:
        """Frames from one key packet to the next."""
        ...

    def file(self, path: Path, *, frames: int | None, resume: bool) -> tuple[PacketSink, StoredStream[State] | None]:
        """A sink to the file, which will have ``frames`` frames (None: unknown), and the existing frames to resume."""
        ...

    def prepare(self, fitted: State, task: FrameTask, facts: StreamFacts) -> tuple[State, StreamHeader]:
        """The reconstruction of a period's first frame, which later frames and receivers use, and its header."""
        ...

    def coder(self, header: StreamHeader, device: torch.device) -> FrameCoder[State]:
        """The coder of the period of this header; decoded states may be on ``device``."""
        ...


@dataclass(frozen=True)
class Pipeline(Generic[State, Memory]):
    """A method and a codec with their configuration.

    Args:
        method: fits frames.
        codec: stores frames.
        config: the resolved configuration as plain JSON values: the header's ``config``.
        seed: seed of all random numbers.
        points: configuration of initial points, for captures without points.
        rate: configuration of the rate control.
        metadata: plain JSON values for every header.
        period: conditions of a new period.
        residual: residual of a decoded frame against its pictures, which ``period.residual`` needs.
        denoising: configuration of the denoising of the frames ``denoised``.
        denoised: indices of the frames whose pictures are averaged with later ones.
    """

    method: Method[State, Memory]
    codec: StreamCodec[State]
    config: Mapping[str, Any]
    seed: int
    points: PointsConfig
    rate: RateConfig = field(default_factory=RateConfig)
    metadata: Mapping[str, Any] = field(default_factory=dict)
    period: PeriodConfig = field(default_factory=PeriodConfig)
    residual: Callable[[State, FrameTask], float] | None = None
    denoising: DenoisingConfig = field(default_factory=DenoisingConfig)
    denoised: tuple[int, ...] = (0,)
