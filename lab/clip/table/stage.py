# SPDX-License-Identifier: Apache-2.0
"""The set table, as a stage."""

from stage import Stage

from table.motion import select_dynamic
from table.room import still_parts
from table.surfaces import all_surfaces

TABLE = Stage(
    all_surfaces, still_parts, select_dynamic, lights_size=1.0, panel=(0.25, -0.25, 2.18), window=(-1.68, -0.55, 0.95)
)
