# SPDX-License-Identifier: Apache-2.0
"""How hard bytes must be saved so that a stream keeps to a rate.

Note [Pressure]
~~~~~~~~~~~~~~~
The steps of a stream are in its header and stay. What can change from frame to frame is the price of a bit while it
is fitted, and how readily free Gaussians are born. Both follow one number, the pressure: 1 is what the configuration
says. It follows from the packets so far alone, so a resumed stream goes on as it would have.
"""

from collections import deque
from dataclasses import dataclass, replace

from structgstream.codec.packets import PacketKind
from structgstream.errors import ConfigError
from structgstream.training.online import OnlineConfig

LEAST, MOST = 1.0 / 16.0, 1024.0
_SPREAD = 1.0 / 3.0
"""Of the window: what it is over or under its budget is made good over so many frames."""


@dataclass(frozen=True)
class RateConfig:
    """What a stream may cost."""

    target_mbits: float | None = None
    """Megabits a second of media time; None: constant quality, whatever it costs."""
    window_seconds: float = 1.0
    """The target holds over this long, the header left aside. At least the interval of key packets, which are large."""


class RateController:
    """Told of every packet in order, it knows the pressure for the next frame.

    The price of a bit grows by what a delta packet was over the room there was for it; since bytes fall with about the
    cube root of the price, that answers a third of the excess. A key packet takes room, and says nothing of the next
    frame.

    Raises:
        ConfigError: a target or window that is not positive.
    """

    def __init__(self, config: RateConfig, fps: float) -> None:
        self.pressure = 1.0
        """From :data:`LEAST` to :data:`MOST`."""
        self._budget: float | None = None  # bytes a frame
        if config.target_mbits is None:
            return
        if config.target_mbits <= 0 or config.window_seconds <= 0:
            raise ConfigError(
                f"A target of {config.target_mbits:g} Mbit/s over {config.window_seconds:g} s; both must be positive."
            )
        self._budget = config.target_mbits * 1e6 / 8.0 / fps
        window = max(2, round(config.window_seconds * fps))
        self._spread = max(1.0, _SPREAD * window)
        self._others: deque[int] = deque(maxlen=window - 1)  # of the window, besides the frame to come

    def add(self, size: int, kind: PacketKind) -> None:
        """A packet of ``size`` bytes was written."""
        if self._budget is None:
            return
        self._others.append(size)
        if kind is PacketKind.KEY:
            return
        saved = self._budget * len(self._others) - sum(self._others)
        room = min(max(self._budget + saved / self._spread, self._budget / 3.0), 2.0 * self._budget)
        self.pressure = min(max(self.pressure * size / room, LEAST), MOST)


def pressed(config: OnlineConfig, pressure: float) -> OnlineConfig:
    """``config`` under a pressure: a bit costs so many times as much, a birth asks for the root of it more gradient."""
    if pressure == 1.0:
        return config
    rounding, patching = config.rounding, config.patching
    return replace(
        config,
        rounding=replace(rounding, rate_weight=rounding.rate_weight * pressure),
        patching=replace(patching, grad_threshold=patching.grad_threshold * pressure**0.5),
    )
