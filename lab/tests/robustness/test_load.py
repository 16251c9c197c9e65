# SPDX-License-Identifier: Apache-2.0
"""The load benchmark, in small: everyone gets everything, and what is not right is seen."""

import asyncio
import hashlib
import json
from pathlib import Path

import pytest

from lab.robustness.load import digests, measured, parsed
from lab.robustness.load_fetch import fetched
from lab.robustness.load_players import play
from lab.robustness.load_report import table
from structgstream.codec.sinks import FileSink
from structgstream.serve.app import ServerSettings
from tests.support.rigs import random_scene
from tests.support.segment_folders import GrowingFolder
from tests.support.serving import hosted
from tests.support.streams import compact_header, moved, small_stream, write_stream

STREAM = small_stream(7)


def test_the_whole_in_small(tmp_path: Path) -> None:
    stream = tmp_path / "small.sgs"
    scenes = [moved(random_scene(60, seed=4), step) for step in range(6)]
    write_stream(FileSink(stream), scenes, header=compact_header(scenes[0]))
    numbers = "--players 4 --rounds 1 --alone-seconds 1 --seconds 12 --connections 2 --turns 1 --turn-seconds 0.3"
    result = measured(parsed([str(stream), *numbers.split(), "--renderings", "20"]))
    alone, together = result["live"]["spans"]
    assert (alone["players"], together["players"]) == (0, 4)
    assert together["fast"]["exact"] == together["fast"]["players"] == 2
    assert together["slow"]["wrong"] == together["slow"]["broken"] == 0
    assert result["live"]["server"]["max_bytes"] > 0
    servers = result["throughput"]["segments"]["servers"]
    assert {"serve", "python -m http.server"} <= servers.keys()
    assert all(one["exact"] for one in servers.values())
    assert "| 2 of 2 |" in table(result)


def test_players_notice_other_bytes(tmp_path: Path) -> None:
    growing = GrowingFolder(tmp_path / "studio", STREAM)
    growing.write_all()
    right = digests(tmp_path / "studio")
    with hosted(ServerSettings(tmp_path)) as server:
        address = f"{server.address}streams/studio/"
        fast = asyncio.run(play(address, fast=2, slow=1, seconds=20.0))
    for one in (*fast["fast"], *fast["slow"]):
        assert (one.frames, one.digest, one.wrong) == (7, right[7], [])
    assert growing.manifest is not None
    file = tmp_path / "studio" / growing.manifest.segments[1].file
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    with hosted(ServerSettings(tmp_path)) as server:
        (one,) = asyncio.run(play(f"{server.address}streams/studio/", fast=1, slow=0, seconds=20.0))["fast"]
    assert one.wrong == [file.name]
    assert one.digest != right[7]


def test_digests_are_those_of_the_stream(tmp_path: Path) -> None:
    GrowingFolder(tmp_path, STREAM).write_all()
    manifest = json.loads((tmp_path / "manifest.json").read_bytes())
    size = manifest["periods"][0]["bytes"] + sum(sum(one["frame_bytes"]) for one in manifest["segments"])
    assert digests(tmp_path)[7] == hashlib.sha256(STREAM[:size]).hexdigest()


def test_fetching_counts_and_checks(tmp_path: Path) -> None:
    (tmp_path / "ball.sgs").write_bytes(STREAM)
    settings = ServerSettings(tmp_path)
    with hosted(settings) as server:
        name = "streams/ball.sgs/stream.sgs"
        found = fetched(server.address, [name], connections=2, seconds=0.3)
    assert found.bytes == found.answers * len(STREAM)
    assert found.digests == {name: hashlib.sha256(STREAM).hexdigest()}


def test_a_server_that_refuses_is_an_error(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    with hosted(ServerSettings(tmp_path)) as server:
        found = asyncio.run(play(f"{server.address}streams/none/", fast=1, slow=0, seconds=1.2))["fast"][0]
    assert found.frames == 0
    assert "404" in found.wrong[0]
