# SPDX-License-Identifier: Apache-2.0
"""Rate control: adapts the weight of the rate term so that a stream meets a target rate.

Note [Rate scale]
~~~~~~~~~~~~~~~~~
The quantization steps of a stream are constant and stored in its header. Rate control multiplies the weight lambda of
the rate term in the loss by one factor, the rate scale, and the thresholds for spawning free Gaussians by its square
root: by gradients (``patching.grad_threshold``) and, above 1, by missing content (``spawn.missing_threshold``), since a
new Gaussian takes about 9 bytes at every rate scale. At 1 all have the configuration's values. The rate scale is a
function of the sizes of earlier packets only, so that a resumed stream is identical.

Note [Windows]
~~~~~~~~~~~~~~~
The budget of a delta packet is computed from a window that ends a third of its length in the future. The sizes of its
past packets are known, and the size of a key packet in its future part is predicted. The delta packets of the future
part share the remainder. So bytes are saved before a key packet comes. A key packet contains all changes since the
period's first frame. Its size is predicted to grow with the square root of its distance from that frame, from that of
the last key packet, other than a period's first, or, before there is one, from the mean size of a delta packet (the
measured sizes are 0.98 to 1.13 times this root times a delta packet's size in 3 streams of 2 captures, frames 1 to 19).

Note [Media time]
~~~~~~~~~~~~~~~~~
Rates are per media time, and a live run may skip pictures. The budget of a packet is then that of all frames of the
media until the next packet, and key packets come sooner (``periods``). The place of a packet is its time in frames
of the media; without gaps it is the frame number. Future packets are expected to have the mean spacing of the packets
in the window. A window has at least as many packets as the shortest group.
"""

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import ClassVar

from structgstream.codec.packets import PacketKind
from structgstream.session.periods import KeyFrames
from structgstream.training.online.config import OnlineConfig

_log = logging.getLogger(__name__)

LEAST, MOST = 1.0 / 16.0, 1024.0
_AHEAD = 1.0 / 3.0
"""Share of the window that lies in the future."""
_FALL, _RISE = 0.5, 4.0
"""Bounds of the factor by which the rate scale changes per frame."""
_MISSED = 1.1
"""A window above this multiple of its budget has missed the target."""


@dataclass(frozen=True)
class _Written:
    """A packet's size in bytes, and its place (Note [Media time])."""

    size: int
    place: int


@dataclass(frozen=True)
class RateConfig:
    """Target of the rate control."""

    target_mbits: float | None = None
    """Target rate in megabits per second of media time; None: constant quality without rate control."""

    WINDOW_SECONDS: ClassVar[float] = 1.0
    """Window, in seconds of media time, over which the target is met, without the header; at least the interval of key
    packets. If frames are skipped it has at least a group of five frames."""


class RateController:
    """Computes the rate scale of the next frame from the sizes of all packets in order.

    The rate scale is multiplied by the ratio of the last delta packet's size to the next one's budget. Bytes fall with
    about the cube root of lambda, so each step corrects about a third of the excess. ``keys`` must receive each packet
    before this object does. A warning is logged when the target starts to be missed.
    """

    def __init__(self, config: RateConfig, fps: float, *, keys: KeyFrames) -> None:
        self.rate_scale = 1.0
        """From :data:`LEAST` to :data:`MOST`."""
        self._budget: float | None = None  # bytes per frame of the media
        if config.target_mbits is None:
            return
        window = max(2, round(config.WINDOW_SECONDS * fps), keys.interval)
        self._budget = config.target_mbits * 1e6 / 8.0 / fps
        self._fps, self._keys, self._window = fps, keys, window
        self._last: deque[_Written] = deque(maxlen=window)
        self._now = 0, 0.0  # number and time of the last packet
        self._origin = 0  # place of the period's first packet
        self._key: tuple[int, int] | None = None  # size of the last key packet, and its distance from the origin
        self._delta: tuple[int, float] | None = None  # size of the last delta packet, and its rate scale
        self._usual = 0.0  # size of delta packets, a running mean
        self._warned = False

    def add(self, size: int, kind: PacketKind, *, index: int, pts_seconds: float, begins: bool = False) -> None:
        """Record a written packet of ``size`` bytes. ``begins``: it begins a period, whose header is not counted."""
        if self._budget is None:
            return
        place = round(pts_seconds * self._fps)
        if begins or not self._last:
            self._origin = place
        self._last.append(_Written(size, place))
        self._now = index, pts_seconds
        if kind is PacketKind.DELTA:
            self._usual = size if self._delta is None else 0.8 * self._usual + 0.2 * size
            self._delta = size, self.rate_scale
        elif place > self._origin:  # A period's first packet is nearly empty, because the header contains its fields.
            self._key = size, place - self._origin
        if self._delta is not None:
            last, rate_scale = self._delta
            factor = min(max(last / self._room(self._budget), _FALL), _RISE)
            self.rate_scale = min(max(rate_scale * factor, LEAST), MOST)
        self._warn_if_missed(index, self._budget)

    def _warn_if_missed(self, index: int, budget: float) -> None:
        """Warns once when the target starts to be missed: a complete window exceeds it by more than :data:`_MISSED`."""
        packets = self._written()
        rate = sum(one.size for one in packets) / self._span(packets)  # bytes per frame of the media
        missed = len(packets) >= self._packets_of_window and rate > _MISSED * budget
        if missed and not self._warned:
            remedy = (
                "nothing more can be saved: take coarser steps (online.rounding.quality), spawn fewer Gaussians "
                "(online.spawn.most) or take a higher target"
            )
            _log.warning(
                "Frame %d: the last %d frames take %.3g Mbit/s, the target is %.3g; %s.",
                index,
                len(packets),
                rate * 8e-6 * self._fps,
                budget * 8e-6 * self._fps,
                remedy if self.rate_scale == MOST else "bytes are saved from now on",
            )
        self._warned = missed

    def _room(self, budget: float) -> float:
        """Budget of the next delta packet in bytes (Note [Windows])."""
        spacing, whole = self._spacing, self._packets_of_window
        each, ahead = budget * spacing, max(1, round(_AHEAD * whole))
        index, pts_seconds = self._now
        coming = self._keys.ahead(index, pts_seconds, spacing=spacing / self._fps)
        keys = [*takewhile(lambda frames: frames <= ahead, coming)]
        past = [*self._last][max(len(self._last) - (whole - ahead), 0) :]
        left = budget * self._span(past) + each * ahead - sum(one.size for one in past)
        left -= len(keys) * self._key_after(keys[0]) if keys else 0.0
        return min(max(left / max(ahead - len(keys), 1), each / 4.0), 3.0 * each)

    def _key_after(self, frames: int) -> float:
        """Predicted size, bytes, of a key packet ``frames`` frames from now (Note [Windows])."""
        since = self._last[-1].place + frames * self._spacing - self._origin
        size, known = (self._usual, self._spacing) if self._key is None else self._key
        return size * (since / known) ** 0.5

    @property
    def _spacing(self) -> float:
        """Mean spacing of the packets of the last window, in frames of the media (Note [Media time])."""
        packets = self._written()
        if len(packets) < 2:
            return 1.0
        return max(packets[-1].place - packets[0].place, 1) / (len(packets) - 1)

    @property
    def _packets_of_window(self) -> int:
        """Number of packets of a window at the present spacing."""
        return min(max(round(self._window / self._spacing), self._keys.least, 2), self._window)

    def _written(self) -> list[_Written]:
        """The packets of the last window."""
        packets = [*self._last]
        begin = packets[-1].place - self._window
        within = sum(1 for one in packets if one.place > begin)
        return packets[-max(within, self._keys.least, 2) :]

    def _span(self, packets: Sequence[_Written]) -> float:
        """Frames of the media from the first of these packets to the one after the last."""
        return packets[-1].place - packets[0].place + self._spacing if packets else 0.0


def with_rate_control(config: OnlineConfig, rate_scale: float) -> OnlineConfig:
    """``config`` with its rate weight multiplied by ``rate_scale``, its gradient threshold for spawning by the square
    root of ``rate_scale``, and its threshold of missing content too, but only if ``rate_scale`` is above 1."""
    if rate_scale == 1.0:
        return config
    rounding, patching, spawn = config.rounding, config.patching, config.spawn
    return replace(
        config,
        rounding=replace(rounding, rate_weight=rounding.rate_weight * rate_scale),
        patching=replace(patching, grad_threshold=patching.grad_threshold * rate_scale**0.5),
        spawn=replace(spawn, missing_threshold=spawn.missing_threshold * max(1.0, rate_scale) ** 0.5),
    )
