# SPDX-License-Identifier: Apache-2.0
"""Names of the formats, apart from what writes them, so that a command line need not load torch to show its help."""

from typing import Literal, get_args

Format = Literal["ply", "splat", "spz"]
FORMATS: tuple[Format, ...] = get_args(Format)
"""Frames as plain 3D Gaussians."""

PageFormat = Literal["html", "site"]
PAGES: tuple[PageFormat, ...] = get_args(PageFormat)
"""The whole stream with a player: in one page, or in a folder for a web server."""
