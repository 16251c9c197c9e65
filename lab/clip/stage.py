# SPDX-License-Identifier: Apache-2.0
"""What a scene has to say of itself to be rendered."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from meshes import Parts
from props import Point


@dataclass(frozen=True)
class Stage:
    """A scene: its surfaces, what stands still, what moves (by the time in seconds), and where its lights are."""

    surfaces: Callable[[], dict[str, Any]]
    still: Callable[[], Parts]
    moving: Callable[[float], Parts]
    lights_size: float  # 1 for the room of ``table``
    panel: Point
    window: Point
