# SPDX-License-Identifier: Apache-2.0
"""Cameras that send while the stream is made: a rig file, a thread a camera, sets of one instant (docs/live.md)."""
