# SPDX-License-Identifier: Apache-2.0
"""Names of the formats; a separate module, so that the help of a command does not load torch."""

from typing import Literal, get_args

Format = Literal["ply", "splat", "spz"]
FORMATS: tuple[Format, ...] = get_args(Format)
"""Formats of frames as plain 3D Gaussians."""

PageFormat = Literal["html", "site"]
PAGES: tuple[PageFormat, ...] = get_args(PageFormat)
"""Formats of the whole stream with a player: a single page, or a folder for a web server."""
