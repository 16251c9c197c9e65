# SPDX-License-Identifier: Apache-2.0
"""Groups of frames that are fitted apart, each from the frame 0 that all of them share, and joined to one stream.

A serial pass tracks what moves through every frame (``track_pass``, ``track_file``); each group is then fitted from
header and track alone (``method``, ``unit``) into a segment (``segment_file``), and ``join`` puts segments together.
"""
