# SPDX-License-Identifier: Apache-2.0
"""Configurations that take seconds."""

from dataclasses import replace

from structgstream.presets import RIG, TINY

TINY_RIG = replace(
    RIG,
    initial=replace(
        TINY.initial,
        seed_voxels=1,
        disturbance=RIG.initial.disturbance,
        solidity=RIG.initial.solidity,
        random_background=False,
    ),
    online=replace(RIG.online, iterations=10, patching=replace(RIG.online.patching, iteration=5)),
)
"""Paper mode as small as the preset tiny: float32, everything fitted in every frame, births by gradients."""
