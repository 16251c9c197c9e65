# SPDX-License-Identifier: Apache-2.0
"""Every constant of the paper's section Implementations, and the ablations as edits of one preset."""

from dataclasses import replace

import pytest

from structgstream.scene.state import PAPER_DYNAMIC
from structgstream.session.presets import PAPER_DATA, PRESETS, PaperData, departures
from tests.support.rigs import arc_rig

PAPER, PAPERS = PRESETS["paper-n3dv"], ["paper-n3dv", "paper-meetroom", "paper-immersive"]


def test_frame_0() -> None:
    initial = PAPER.initial
    assert initial.voxel_size == 0.005
    assert initial.offsets_per_anchor == 5
    assert initial.FEATURE_WIDTH == 32
    assert initial.iterations == 4000
    assert initial.growth.start == 1500
    assert initial.distance_input
    assert not initial.camera_color
    assert not initial.random_background
    assert not PAPER.environment.enabled
    assert initial.coarse_iterations == initial.medium_iterations == 0


def test_loss() -> None:
    initial, online = PAPER.initial.losses, PAPER.online.losses
    assert (initial.l1, initial.ssim, initial.volume, initial.offset_distance) == (1.0, 0.2, 0.01, 0.005)
    assert (online.l1, online.ssim, online.volume) == (1.0, 0.2, 0.01)


def test_online() -> None:
    online = PAPER.online
    assert online.iterations == 100
    assert online.dynamic == PAPER_DYNAMIC
    rates = online.rates
    assert (rates.ANCHOR_POSITIONS, rates.OFFSET_SCALES, rates.COVARIANCE_MLP) == (4e-4, 5e-3, 4e-3)
    free = (
        rates.FREE_MEANS,
        rates.FREE_LOG_SCALES,
        rates.FREE_QUATS,
        rates.FREE_LOGIT_OPACITIES,
        rates.FREE_COLORS,
    )
    assert free == (2e-4, 5e-3, 1e-3, 5e-2, 2.5e-3)
    assert rates.final_share == 1.0


def test_patching() -> None:
    patching = PAPER.online.patching
    assert patching.iteration == 50
    assert patching.grad_threshold == 1e-3
    assert patching.COVARIANCE_FACTOR == 2.0
    assert patching.OPACITY == 0.1
    assert patching.prune_opacity == 0.005
    assert patching.lifetime == "stream"
    assert patching.spawn == "gradient"


def test_one_set_of_constants_is_printed_for_all_data_sets() -> None:
    """Section Implementations names no data set; a constant that differed would have to be made up."""
    assert len({PRESETS[name] for name in PAPERS}) == 1
    assert list(PAPER_DATA) == PAPERS


def test_what_differs_is_the_data() -> None:
    """Section Datasets."""
    assert {name: (data.width, data.height, data.cameras) for name, data in PAPER_DATA.items()} == {
        "paper-n3dv": (1352, 1014, 21),
        "paper-meetroom": (1280, 720, 13),
        "paper-immersive": (1280, 960, 46),
    }
    assert [data.held_out for data in PAPER_DATA.values()] == [None, 1, 1]


def test_what_published_loaders_do_where_the_paper_is_silent() -> None:
    assert [data.held_out_camera for data in PAPER_DATA.values()] == ["cam00", "cam_0", "camera_0001"]
    assert [data.scale for data in PAPER_DATA.values()] == [0.5, 1.0, 0.5]


def test_another_rig_than_the_papers_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = arc_rig(4)
    assert departures("paper-immersive", rig) == [
        "pictures of 48x32 instead of 1280x960 (--scale 0.5 of the stored)",
        "4 cameras instead of 46",
    ]
    assert departures("rig", rig) == []
    small = PaperData(48, 32, cameras=4, held_out=None, held_out_camera="cam00")
    monkeypatch.setitem(PAPER_DATA, "paper-n3dv", small)  # type: ignore[arg-type]
    assert departures("paper-n3dv", rig) == []
    assert departures("paper-n3dv", rig.with_held_out(frozenset({"cam01"}))) == ["cam00 trained on instead of held out"]
    monkeypatch.setitem(PAPER_DATA, "paper-n3dv", replace(small, held_out=2))  # type: ignore[arg-type]
    assert departures("paper-n3dv", rig) == ["1 held out instead of 2"]
