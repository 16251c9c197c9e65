# SPDX-License-Identifier: Apache-2.0
"""Captures: readers of common layouts with one protocol, resizing, prefetching."""

from structgstream.data.clip import bundled_clip
from structgstream.data.open import open_capture
from structgstream.data.prefetch import Prefetch
from structgstream.data.source import FrameSource

__all__ = ["FrameSource", "Prefetch", "bundled_clip", "open_capture"]
