# SPDX-License-Identifier: Apache-2.0
"""Names of the formats, apart from what writes them, so that a command line need not load torch to show its help."""

from typing import Literal, get_args

Format = Literal["ply", "splat", "spz"]
FORMATS: tuple[Format, ...] = get_args(Format)
