# SPDX-License-Identifier: Apache-2.0
"""A capture whose pictures are in memory."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame


@dataclass
class MemoryCapture:
    """What every capture looks like (``data/source.py``), around frames that are there already."""

    rig: CameraRig
    pictures: Sequence[MultiViewFrame]
    fps: float = 30.0
    name: str = "world"
    points: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.pictures)

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        yield from self.pictures[start:]
