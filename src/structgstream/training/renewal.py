# SPDX-License-Identifier: Apache-2.0
"""Renewal of free Gaussians after the motion start: removal of outliers, and births where content is missing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.kernels.values import TileSelection
from structgstream.scene.focus import Focus
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.training.birth_sweep import Missing, Sweep, missing_share
from structgstream.training.births import BirthConfig, Births, blamed_mask
from structgstream.training.observation import weigh_maps
from structgstream.training.partition import Partition
from structgstream.training.residuals import ResidualFloor
from structgstream.training.views import View


@dataclass(frozen=True)
class Renewal:
    """Result of the renewal of a moving part's free Gaussians.

    Args:
        kept: mask ``[F]`` of those that are kept.
        new_free: those that are born.
        thin_count: how many of them are thin content's.
        thin_refused_count: how many thin ones were not born because they would have been too many.
        merged_count: how many more would have been born, had they not been made coarser because they were too many.
        refused: whether too much is missing for births.
    """

    kept: Tensor
    new_free: FreeGaussians
    thin_count: int = 0
    thin_refused_count: int = 0
    merged_count: int = 0
    refused: bool = False

    @property
    def counts(self) -> dict[str, int]:
        """How often each part acted, for the log."""
        return {
            "born": len(self.new_free),
            "born thin": self.thin_count,
            "thin births refused": self.thin_refused_count,
            "births merged": self.merged_count,
            "blamed": int((~self.kept).sum()),
            "births refused": int(self.refused),
        }


def renew_free_gaussians(
    partition: Partition,
    views: Sequence[View],
    focuses: Mapping[int, Focus],
    *,
    first_birth: int,
    floor: ResidualFloor | None,
    room: int,
    least_pixels: float,
    config: BirthConfig,
    backend: Backend,
) -> Renewal:
    """Removal and births of free Gaussians before the first iteration.

    Args:
        partition: with its moving part after the motion start.
        views: of the frame.
        focuses: by view index, the focus on the moving part.
        first_birth: identity of the first birth.
        floor: residuals of frame 0; None for none.
        room: largest number of births.
        least_pixels: views where a Gaussian covers fewer pixels do not count.
        config: the rules.
        backend: the compute back-end.
    """
    moving, still = (part.with_folded_appearance() for part in (partition.moving, partition.still))
    everything = torch.ones(len(moving.free), dtype=torch.bool, device=moving.free.means.device)
    none = Renewal(everything, FreeGaussians.empty(moving.free.means))
    if not config.enabled or not focuses:
        return none
    with torch.no_grad():
        eased = floor
        if floor is not None and config.changed_floor_medians is not None:
            eased = floor.eased(partition.segmentation.changed, medians=config.changed_floor_medians)
        sweep = Sweep(moving, still, views, focuses, eased, config, backend)
        missing = sweep.missing()
        if missing_share(missing) > config.most_missing_share:
            return replace(none, refused=True)
        kept = everything
        if len(moving.free):
            kept = ~_blamed_mask(moving, missing, focuses, least_pixels=least_pixels, config=config, backend=backend)
        if not kept.all():
            sweep = replace(sweep, moving=replace(moving, free=moving.free.select(kept)))
            missing = sweep.drawn(missing)
        room = max(0, room - int(kept.sum()))
        large = sweep.births(missing, first_birth=first_birth, room=room)
        if len(large.free) or not config.thin.enabled:
            return Renewal(kept, large.free, merged_count=large.merged_count)
        known = {entry.view.index: entry for entry in missing}
        # With all of frame 0's floor: by these low thresholds an eased one would take all that moves for thin content.
        thin_sweep = replace(sweep, floor=floor, config=config.for_thin, known=known)
        thin = _thin_births(thin_sweep, first_birth=first_birth, room=room)
    return Renewal(kept, thin.free, len(thin.free), thin.refused_count)


def _thin_births(sweep: Sweep, *, first_birth: int, room: int) -> Births:
    """Births of thin content, where nothing large is born."""
    missing = sweep.missing(blames=False)
    if missing_share(missing) > sweep.config.most_missing_share:
        return Births(FreeGaussians.empty(sweep.moving.free.means))
    return sweep.births(missing, first_birth=first_birth, room=room)


def _blamed_mask(
    moving: Scene,
    missing: Sequence[Missing],
    focuses: Mapping[int, Focus],
    *,
    least_pixels: float,
    config: BirthConfig,
    backend: Backend,
) -> Tensor:
    coverage, wrong = [], []
    for entry in missing:
        view = entry.residual.view
        focus, camera = focuses.get(view.index), view.camera
        if focus is None:
            continue
        # Elsewhere free Gaussians cover nothing: maps that are zero there cost nothing.
        free = moving.free_gaussians()
        reached = backend.rasterize(free, camera.viewport(free.means)).alpha > 0.0
        counting = reached if view.mask is None else reached & view.mask
        maps = torch.stack([counting, counting & entry.residual.wrong], dim=-1).to(entry.residual.missing_share)
        gaussians = moving.with_free_gaussians(moving.structured(camera, backend, tiles=TileSelection.of(reached)))
        sums = weigh_maps(gaussians, camera, maps, backend, still=focus.still)
        of_free = sums[len(sums) - len(moving.free) :]  # Free Gaussians are the last, and all there.
        coverage.append(of_free[:, 0])
        wrong.append(of_free[:, 1])
    return blamed_mask(torch.stack(coverage), torch.stack(wrong), least_pixels=least_pixels, config=config)
