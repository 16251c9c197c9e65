# SPDX-License-Identifier: Apache-2.0
"""What makes a stream of a capture: a method that fits frames, and a codec that stores them.

Struct-GStream with its two codecs is one pipeline (``struct_gstream.py``), every peer is another (``peers/``);
``session.py`` runs them all.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.codec.encoder import Encoded
from structgstream.codec.packets import Packet, PacketKind, PacketSink, StreamHeader
from structgstream.codec.reader import PacketInfo
from structgstream.data.points import PointsConfig
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.rate_control import RateConfig
from structgstream.scene.render import Drawable
from structgstream.similarity import Similarity
from structgstream.training.pictures import FramePictures
from structgstream.training.result import FitResult, StepListener

State = TypeVar("State", bound=Drawable)
"""A frame as a receiver holds it; it may have a length, its number of Gaussians."""
State_co = TypeVar("State_co", bound=Drawable, covariant=True)
Memory = TypeVar("Memory")
"""What the encoder alone keeps from frame 0 on."""


@dataclass(frozen=True)
class FrameTask:
    """What a method is given to fit one frame; everything in normalised units.

    Args:
        frame: its pictures and its time.
        pictures: those of the training cameras, as the method observed them.
        rig: all cameras; held-out ones are not looked at.
        points: makes initial points ``[P, 3]`` of the frame, which may take a while.
        backend: what computes.
        seed: all randomness comes from it, so a frame can be repeated alone.
        steps: of what the codec sends rounded, by name; empty in frame 0.
        pressure: how hard bytes must be saved (``rate_control``, Note [Pressure]).
        on_step: called after every optimisation step.
    """

    frame: MultiViewFrame
    pictures: FramePictures
    rig: CameraRig
    points: Callable[[], Tensor]
    backend: Backend
    seed: int
    steps: Mapping[str, float] = field(default_factory=dict)
    pressure: float = 1.0
    on_step: StepListener | None = None


@dataclass(frozen=True)
class Past(Generic[State, Memory]):
    """What a frame is fitted after.

    Args:
        state: the decoded frame before it (``codec.encoder``, Note [Closed loop]).
        memory: see :meth:`Method.prepare`.
        older: the decoded frame before that, for methods that ask for it.
    """

    state: State
    memory: Memory
    older: State | None = None


class Method(Protocol[State, Memory]):
    """How frames are fitted. A frame depends on its task and its past alone, so that a resumed stream is the same."""

    @property
    def needs_before(self) -> bool:
        """Whether :meth:`observe` looks at the pictures of the frame before."""
        ...

    @property
    def needs_older(self) -> bool:
        """Whether a frame is fitted after the two decoded frames before it, instead of one."""
        ...

    def observe(
        self, frame: MultiViewFrame, before: MultiViewFrame | None, *, rig: CameraRig, backend: Backend
    ) -> FramePictures:
        """What the pictures tell by themselves; called while the frame before is fitted, in a thread of its own."""
        ...

    def first(self, task: FrameTask) -> FitResult[State]:
        """Fit frame 0."""
        ...

    def prepare(self, state: State, task: Callable[[], FrameTask]) -> Memory:
        """What later frames need of the decoded frame 0 and, if the method asks, of its task."""
        ...

    def next(self, past: Past[State, Memory], task: FrameTask) -> FitResult[State]:
        """Fit a later frame."""
        ...


@dataclass(frozen=True)
class StreamFacts:
    """What the header says of a run, and what a run must share with the stream that it continues.

    Args:
        codec: name of the codec.
        rig: every camera, in the capture's own units.
        similarity: from the capture's units to the scene's.
        fps: frames per second of the media.
        config: the resolved configuration, as plain JSON values.
        metadata: capture name, start frame and the like, as plain JSON values.
    """

    codec: str
    rig: CameraRig
    similarity: Similarity
    fps: float
    config: Mapping[str, Any]
    metadata: Mapping[str, Any]


class StoredStream(Protocol[State_co]):
    """What a file holds already: ``StreamReader`` is one."""

    @property
    def header(self) -> StreamHeader: ...

    @property
    def packets(self) -> Sequence[PacketInfo]: ...

    @property
    def complete(self) -> bool: ...

    def __len__(self) -> int: ...

    def group(self, index: int) -> Iterator[Packet]:
        """The packets that frame ``index`` needs, from a key packet to its own."""
        ...

    def scene(self, index: int) -> State_co:
        """The decoded frame ``index``, on the CPU."""
        ...


class Coder(Protocol[State]):
    """Encodes and decodes the frames of one stream, in order; ``SceneEncoder`` is one."""

    def encode(self, state: State, /, *, index: int, pts_seconds: float, kind: PacketKind) -> Encoded[State]:
        """The packet of a frame, and what the decoder makes of it."""
        ...

    def follow(self, packet: Packet) -> State:
        """Decode a packet that is there already, and go on after it."""
        ...


class StreamCodec(Protocol[State]):
    """How frames are stored."""

    @property
    def name(self) -> str:
        """What the header's ``codec`` says."""
        ...

    def key_interval(self, fps: float) -> int:
        """Frames from one key packet to the next."""
        ...

    def file(self, path: Path, *, frames: int, resume: bool) -> tuple[PacketSink, StoredStream[State] | None]:
        """The file that the stream goes to, ``frames`` long in the end, and what it holds, if it is to be resumed."""
        ...

    def prepare(self, fitted: State, task: FrameTask, facts: StreamFacts) -> tuple[State, StreamHeader]:
        """Frame 0 as the frames after it start from it, and the header of the stream."""
        ...

    def coder(self, header: StreamHeader, device: torch.device) -> Coder[State]:
        """What encodes and decodes the stream of this header; states that it decodes may lie on ``device``."""
        ...


@dataclass(frozen=True)
class Pipeline(Generic[State, Memory]):
    """A method and a codec, with what decides their result.

    Args:
        method: fits.
        codec: stores.
        config: the resolved configuration as plain JSON values: the header's ``config``.
        seed: of everything random.
        normalised_radius: largest distance of a training camera to their mean after normalisation.
        points: how initial points are made when the capture brings none.
        rate: a rate to keep to.
        metadata: plain JSON values for every header.
    """

    method: Method[State, Memory]
    codec: StreamCodec[State]
    config: Mapping[str, Any]
    seed: int
    normalised_radius: float
    points: PointsConfig
    rate: RateConfig = field(default_factory=RateConfig)
    metadata: Mapping[str, Any] = field(default_factory=dict)
