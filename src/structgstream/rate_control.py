# SPDX-License-Identifier: Apache-2.0
"""Rate control: adapts the price of bits so that a stream keeps to a target rate.

Note [Pressure]
~~~~~~~~~~~~~~~
The quantization steps of a stream are fixed in its header. Rate control changes the price of a bit in the loss, and the
gradient threshold for spawning free Gaussians, by one factor, the pressure; 1 leaves the configuration's values. It is
a function of the sizes of earlier packets only, so that a resumed stream is identical.

Note [Windows]
~~~~~~~~~~~~~~
The budget of a delta packet is taken from the window that ends a third of its length in the future: the sizes of its
past packets are known, the size of a key packet in its future part is predicted, and the remainder is shared by the
delta packets there. So bytes are saved before a key packet comes. A key packet has all changes since frame 0; its size
is predicted as that of a delta packet times the square root of its frame number (0.98 to 1.13 times that in 3 streams
of 2 captures, frames 1 to 19).
"""

import logging
from collections import deque
from dataclasses import dataclass, replace

from structgstream.codec.packets import PacketKind
from structgstream.errors import ConfigError
from structgstream.training.online import OnlineConfig

_log = logging.getLogger(__name__)

LEAST, MOST = 1.0 / 16.0, 1024.0
_AHEAD = 1.0 / 3.0
"""Share of the window that lies in the future."""
_FALL, _RISE = 0.5, 4.0
"""Bounds of the factor by which the pressure changes per frame."""
_MISSED = 1.1
"""A window above this multiple of its budget has missed the target."""


@dataclass(frozen=True)
class RateConfig:
    """Target of the rate control."""

    target_mbits: float | None = None
    """Target rate in megabits per second of media time; None: constant quality without rate control."""
    window_seconds: float = 1.0
    """Window, in seconds of media time, over which the target holds, without the header; at least the interval of key
    packets."""


class RateController:
    """Computes the pressure of the next frame from the sizes of all packets in order.

    The pressure is multiplied by the ratio of the last delta packet's size to the next one's budget. Bytes fall with
    about the cube root of the price, so each step corrects about a third of the excess.

    Args:
        config: the target.
        fps: frames per second of the media.
        key_interval: frames from one key packet to the next.

    A warning is logged when the target starts to be missed.

    Raises:
        ConfigError: a target or window that is not positive, or a window shorter than a group.
    """

    def __init__(self, config: RateConfig, fps: float, *, key_interval: int) -> None:
        self.pressure = 1.0
        """From :data:`LEAST` to :data:`MOST`."""
        self._budget: float | None = None  # bytes a frame
        if config.target_mbits is None:
            return
        if config.target_mbits <= 0 or config.window_seconds <= 0:
            raise ConfigError(
                f"A target of {config.target_mbits:g} Mbit/s over {config.window_seconds:g} s; both must be positive."
            )
        window = max(2, round(config.window_seconds * fps))
        if window < key_interval:
            raise ConfigError(
                f"A rate over {config.window_seconds:g} s cannot be kept with a key packet every "
                f"{key_interval / fps:g} s; make rate.window_seconds at least key_interval_seconds."
            )
        self._budget = config.target_mbits * 1e6 / 8.0 / fps
        self._fps, self._interval = fps, key_interval
        self._ahead = max(1, round(_AHEAD * window))
        self._last: deque[int] = deque(maxlen=window)
        self._count = 0
        self._origin = 0  # the first frame of the period
        self._key: tuple[int, int] | None = None  # the last key packet's size and frame
        self._delta: tuple[int, float] | None = None  # the last delta packet's size, and its pressure
        self._usual = 0.0  # size of delta packets, a running mean
        self._said = False

    def add(self, size: int, kind: PacketKind, *, begins: bool = False) -> None:
        """Record a written packet of ``size`` bytes; ``begins``: with a header of its own, which is not counted."""
        if self._budget is None:
            return
        self._last.append(size)
        if begins:
            self._origin = self._count
        self._count += 1
        if kind is PacketKind.DELTA:
            self._usual = size if self._delta is None else 0.8 * self._usual + 0.2 * size
            self._delta = size, self.pressure
        elif self._count - 1 > self._origin:  # A period's first packet is nearly empty: the header has its fields.
            self._key = size, self._count - 1 - self._origin
        if self._delta is not None:
            last, pressure = self._delta
            factor = min(max(last / self._room(self._budget), _FALL), _RISE)
            self.pressure = min(max(pressure * factor, LEAST), MOST)
        if self.missed and not self._said:
            remedy = "nothing more can be saved: take coarser steps (online.rounding.quality) or a higher target"
            _log.warning(
                "Frame %d: the last %d frames take %.3g Mbit/s, the target is %.3g; %s.",
                self._count - 1,
                len(self._last),
                self.rate_mbits,
                self._budget * 8e-6 * self._fps,
                remedy if self.pressure == MOST else "more is saved from now on",
            )
        self._said = self.missed

    def _room(self, budget: float) -> float:
        """Budget of the next delta packet in bytes (Note [Windows])."""
        assert self._last.maxlen is not None, "a window has a length"
        keys = sum(1 for frame in range(self._count, self._count + self._ahead) if frame % self._interval == 0)
        past = [*self._last][max(len(self._last) - (self._last.maxlen - self._ahead), 0) :]
        left = budget * (len(past) + self._ahead) - sum(past) - keys * self._next_key()
        return min(max(left / max(self._ahead - keys, 1), budget / 4.0), 3.0 * budget)

    def _next_key(self) -> float:
        """Predicted size of the next key packet in bytes (Note [Windows])."""
        frame = -(-self._count // self._interval) * self._interval
        size, known = (self._usual, 1) if self._key is None else self._key
        return size * ((frame - self._origin) / known) ** 0.5

    @property
    def rate_mbits(self) -> float | None:
        """Rate of the last window; None without a target."""
        if self._budget is None or not self._last:
            return None
        return sum(self._last) * 8e-6 * self._fps / len(self._last)

    @property
    def missed(self) -> bool:
        """Whether a complete window exceeds its budget by more than :data:`_MISSED` allows."""
        return (
            self._budget is not None
            and len(self._last) == self._last.maxlen
            and sum(self._last) > _MISSED * self._budget * len(self._last)
        )


def with_rate_control(config: OnlineConfig, pressure: float) -> OnlineConfig:
    """``config`` with the price of a bit times ``pressure``, and the spawning threshold times its square root."""
    if pressure == 1.0:
        return config
    rounding, patching = config.rounding, config.patching
    return replace(
        config,
        rounding=replace(rounding, rate_weight=rounding.rate_weight * pressure),
        patching=replace(patching, grad_threshold=patching.grad_threshold * pressure**0.5),
    )
