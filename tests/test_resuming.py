# SPDX-License-Identifier: Apache-2.0
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from rigs import arc_rig
from streams import header_for, small_scene
from structgstream.cameras import CameraRig
from structgstream.errors import ConfigError
from structgstream.frames import MultiViewFrame
from structgstream.presets import TINY, StreamConfig, to_json
from structgstream.rate_control import RateConfig
from structgstream.resuming import check_resumable

RIG = arc_rig(3)
METADATA = {"capture": "test", "start": 0}
HEADER = replace(header_for(small_scene()), rig=RIG, config=to_json(TINY), metadata=METADATA)
LAST = [*RIG][-1]


@dataclass
class Capture:
    """A rig without pictures."""

    rig: CameraRig = RIG
    fps: float = 30.0
    name: str = "test"
    points: np.ndarray | None = None

    def __len__(self) -> int:
        return 0

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        yield from ()


def refused(capture: Capture | None = None, *, config: StreamConfig = TINY, metadata: dict | None = None) -> str:
    with pytest.raises(ConfigError) as caught:
        check_resumable(
            HEADER,
            Capture() if capture is None else capture,
            config=config,
            metadata=METADATA if metadata is None else metadata,
        )
    return str(caught.value)


def changed(**facts: object) -> Capture:
    cameras = {**RIG.cameras, LAST: replace(RIG[LAST], **facts)}
    return Capture(CameraRig(cameras, RIG.held_out))


def test_the_same_run_may_go_on() -> None:
    check_resumable(HEADER, Capture(), config=replace(TINY), metadata=dict(METADATA))


def test_what_differs_is_named() -> None:
    other = replace(TINY, rate=RateConfig(1.0), online=replace(TINY.online, iterations=3))
    assert "another configuration: online.iterations, rate.target_mbits differ" in refused(config=other)
    assert "another part of it: start differ" in refused(metadata={**METADATA, "start": 2})
    assert "another part of it: fps differ" in refused(Capture(fps=25.0))


def test_every_fact_of_a_camera_counts() -> None:
    viewmat = RIG[LAST].viewmat.clone()
    viewmat[0, 3] += 1e-9
    for facts, name in (
        ({"viewmat": viewmat}, "viewmat"),
        ({"K": RIG[LAST].K * 1.0 + 1e-9 * (RIG[LAST].K > 0)}, "K"),
        ({"near": 2.0 * RIG[LAST].near}, "near"),
        ({"width": RIG[LAST].width + 1}, "size"),
    ):
        assert f"another part of it: cameras.{LAST}.{name} differ" in refused(changed(**facts))
    turned = Capture(CameraRig({name: RIG[name] for name in [*RIG][::-1]}, RIG.held_out))
    assert "another part of it: order of cameras differ" in refused(turned)
    assert f"cameras.{LAST}.held out" in refused(Capture(CameraRig(dict(RIG.cameras), frozenset({LAST}))))


def test_many_differences_are_cut_short() -> None:
    cameras = {name: replace(RIG[name], near=0.5, width=7) for name in RIG}
    message = refused(Capture(CameraRig(cameras, RIG.held_out)), metadata=METADATA)
    assert (
        "cameras.cam00.near, cameras.cam00.size, cameras.cam01.near, cameras.cam01.size, cameras.cam02.near differ"
        in (message)
    )
