# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import pytest

from structgstream.cameras import CameraRig, Similarity
from structgstream.errors import ConfigError
from structgstream.session.loop import check_resumable
from structgstream.session.pipeline import StreamFacts
from structgstream.session.presets import TINY, to_json
from structgstream.session.rate_control import RateConfig
from tests.support.rigs import arc_rig
from tests.support.streams import header_for, small_scene

RIG = arc_rig(3)
METADATA = {"capture": "test", "start": 0}
HEADER = replace(header_for(small_scene()), rig=RIG, config=to_json(TINY), metadata=METADATA)
LAST = [*RIG][-1]


FACTS = StreamFacts(HEADER.codec, RIG, Similarity(), 30.0, to_json(TINY), METADATA)


def refused(**changes: object) -> str:
    with pytest.raises(ConfigError) as caught:
        check_resumable(HEADER, replace(FACTS, **changes))
    return str(caught.value)


def changed(**facts: object) -> CameraRig:
    return CameraRig({**RIG.cameras, LAST: replace(RIG[LAST], **facts)}, RIG.held_out)


def test_the_same_run_may_go_on() -> None:
    check_resumable(HEADER, replace(FACTS, config=to_json(replace(TINY)), metadata=dict(METADATA)))


def test_what_differs_is_named() -> None:
    other = replace(TINY, rate=RateConfig(1.0), online=replace(TINY.online, iterations=3))
    assert "another configuration: online.iterations, rate.target_mbits differ" in refused(config=to_json(other))
    assert "seed differ. Resume with the same preset" in refused(config=to_json(replace(TINY, seed=3)))
    later = refused(metadata={**METADATA, "start": 2})
    assert "another part of it: start differ. Resume with the same capture" in later
    assert "another part of it: fps differ" in refused(fps=25.0)
    renamed = refused(metadata={**METADATA, "capture": "renamed"})
    assert f"capture and options (in the stream: capture {METADATA['capture']!r}), or start again" in renamed


def test_every_fact_of_a_camera_counts() -> None:
    viewmat = RIG[LAST].viewmat.clone()
    viewmat[0, 3] += 1e-9
    for facts, name in (
        ({"viewmat": viewmat}, "viewmat"),
        ({"K": RIG[LAST].K * 1.0 + 1e-9 * (RIG[LAST].K > 0)}, "K"),
        ({"near": 2.0 * RIG[LAST].near}, "near"),
        ({"width": RIG[LAST].width + 1}, "width"),
    ):
        assert f"another part of it: cameras.{LAST}.{name} differ" in refused(rig=changed(**facts))
    turned = CameraRig({name: RIG[name] for name in [*RIG][::-1]}, RIG.held_out)
    assert "another part of it: order of cameras differ" in refused(rig=turned)
    assert f"cameras.{LAST}.held_out" in refused(rig=CameraRig(dict(RIG.cameras), frozenset({LAST})))


def test_another_method_is_named() -> None:
    assert f"another method or codec, {HEADER.codec!r} instead of '3dgs'" in refused(codec="3dgs")


def test_many_differences_are_cut_short() -> None:
    cameras = {name: replace(RIG[name], near=0.5, width=7) for name in RIG}
    message = refused(rig=CameraRig(cameras, RIG.held_out))
    first_five = [f"cameras.cam0{n}.{fact}" for n in range(3) for fact in ("near", "width")][:5]
    assert f"{', '.join(first_five)} differ" in message
