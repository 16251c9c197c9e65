# SPDX-License-Identifier: Apache-2.0
"""Captures: readers of common layouts with one protocol, resizing, prefetching."""

from structgstream.data.dataset_layouts import bundled_clip
from structgstream.data.open import open_capture
from structgstream.data.source import FrameSource
from structgstream.data.wrappers import Prefetch

__all__ = ["FrameSource", "Prefetch", "bundled_clip", "open_capture"]
