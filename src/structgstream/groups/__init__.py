# SPDX-License-Identifier: Apache-2.0
"""Groups of frames that are fitted independently, each from a shared frame 0, and joined to one stream.

A serial pass tracks dynamic primitives through every frame (``track_pass``, ``track_file``). Each group is then fitted
from header and track alone (``unit``) into a segment (``segment_file``), and ``join`` joins the segments.
"""
