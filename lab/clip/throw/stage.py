# SPDX-License-Identifier: Apache-2.0
"""The throw, as a stage."""

from stage import Stage

from throw.motion import select_dynamic
from throw.room import still_parts
from throw.surfaces import all_surfaces

THROW = Stage(
    all_surfaces, still_parts, select_dynamic, lights_size=2.0, panel=(0.4, -0.6, 2.98), window=(-3.18, -1.9, 1.55)
)
