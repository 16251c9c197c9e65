# SPDX-License-Identifier: Apache-2.0
"""Every frame from scratch with Scaffold-GS (Lu et al. 2024): this project's frame 0 without what the paper adds."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.codec.packets import check_shapes
from structgstream.errors import StreamError
from structgstream.scene.scene import Scene
from structgstream.scene.state import STATE_TABLE, FieldName, on_device, scene_of, state_of
from structgstream.session.pipeline import FrameTask
from structgstream.session.presets import RIG
from structgstream.training.frame0.fit import InitialConfig, fit_first_frame
from structgstream.training.losses import InitialLossWeights
from structgstream.training.result import FitResult
from structgstream_studies.peers.method import Arrays, IndependentFrames, stored

SCAFFOLD = replace(
    RIG.initial, distance_input=False, losses=InitialLossWeights(l1=0.8, ssim=0.2, volume=0.01, offset_distance=0.0)
)
"""The preset ``rig`` with Scaffold-GS's inputs and loss: no distance, no term that keeps offsets short."""


@dataclass(frozen=True)
class ScaffoldGS(IndependentFrames[Scene]):
    """The method behind the loop. No frame knows of another, and nothing is remembered."""

    config: InitialConfig = field(default_factory=lambda: SCAFFOLD)
    name: str = "scaffold-gs"

    def first(self, task: FrameTask) -> FitResult[Scene]:
        """Any frame: see ``training.initial.fit_first_frame``."""
        return fit_first_frame(
            task.frame,
            task.rig,
            task.points(),
            config=self.config,
            backend=task.backend,
            seed=task.seed,
            on_step=task.on_step,
        )

    def arrays(self, state: Scene) -> Arrays:
        """Every tensor of the scene."""
        return {name: stored(value, value.dtype) for name, value in state_of(state).items()}

    def restored(self, arrays: Mapping[str, NDArray[Any]], previous: Scene | None, *, device: torch.device) -> Scene:
        """The decoder.

        Raises:
            StreamError: the arrays are not those of this method.
        """
        names: list[FieldName] = [f.name for f in STATE_TABLE if not f.optional]
        if set(arrays) != set(names):
            raise StreamError(f"The frame has the arrays {', '.join(sorted(arrays))}; expected {', '.join(names)}.")
        fields: dict[FieldName, Tensor] = {name: torch.from_numpy(arrays[name].copy()) for name in names}
        color = arrays["camera_color"]
        cameras = color.shape[0] if color.ndim else 0
        check_shapes(fields, distance_input=False, training_cameras=cameras, where="The frame")
        return on_device(scene_of(fields, distance_input=False), device)
