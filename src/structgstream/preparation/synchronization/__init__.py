# SPDX-License-Identifier: Apache-2.0
"""Clocks of cameras that run freely, from tables, time stamps, sound or motion, and the check of captures."""

from structgstream.preparation.synchronization.audio import distances_from
from structgstream.preparation.synchronization.check import SynchronizationCheck, check_synchronization
from structgstream.preparation.synchronization.result import ClockEstimate, Synchronization
from structgstream.preparation.synchronization.streams import Streams
from structgstream.preparation.synchronization.synchronize import METHODS, Method, synchronize

__all__ = [
    "METHODS",
    "ClockEstimate",
    "Method",
    "Streams",
    "Synchronization",
    "SynchronizationCheck",
    "check_synchronization",
    "distances_from",
    "synchronize",
]
