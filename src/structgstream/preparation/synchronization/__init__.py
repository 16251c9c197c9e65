# SPDX-License-Identifier: Apache-2.0
"""Clocks of cameras that run freely, from tables, time stamps, sound or motion."""

from structgstream.preparation.synchronization.synchronize import (
    METHODS,
    ClockEstimate,
    Method,
    Streams,
    Synchronization,
    synchronize,
)

__all__ = ["METHODS", "ClockEstimate", "Method", "Streams", "Synchronization", "synchronize"]
