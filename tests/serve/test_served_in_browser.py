# SPDX-License-Identifier: Apache-2.0
"""The served pages in a real browser: the list, and a stream that needs a token."""

import re
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from structgstream.codec.segments.quality_list import ListedQuality, write_list
from structgstream.codec.sinks import MemorySink
from structgstream.evaluation.pictures import png_bytes
from structgstream.serve.access import EVERY_STREAM, TokenKeys
from structgstream.serve.app import ServerSettings
from tests.support.chromium import Browser, Tab, opened_browser
from tests.support.rigs import random_scene
from tests.support.segment_folders import GrowingFolder
from tests.support.serving import hosted
from tests.support.streams import compact_header, moved, write_stream

KEYS = TokenKeys((b"a secret of thirty-two characters",))
SHOWN = 'document.querySelector("structgstream-player")?.stats?.settled'


def answered(metrics: str, kind: str, stream: str) -> bool:
    """Whether the server has sent files of a kind."""
    sample = rf'structgstream_requests_total{{kind="{kind}",status="20.",stream="{stream}"}}'
    return re.search(sample, metrics) is not None


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with opened_browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.fixture
def tab(browser: Browser) -> Iterator[Tab]:
    with browser.opened_tab() as opened:
        yield opened


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    sink = MemorySink()
    scenes = [moved(random_scene(60, seed=4), step) for step in range(6)]
    write_stream(sink, scenes, header=compact_header(scenes[0]))
    streams = tmp_path / "streams"
    GrowingFolder(streams / "studio", sink.data).write()
    (streams / "ball.sgs").write_bytes(sink.data)
    for path in (streams / "studio" / "preview.png", streams / "ball.preview.png"):
        path.write_bytes(png_bytes(np.full((6, 8, 3), 200, np.uint8)))
    return streams


def test_from_the_list_to_a_picture_with_one_token(tab: Tab, folder: Path) -> None:
    token = KEYS.token(EVERY_STREAM, expires_unix_seconds=int(time.time()) + 600)
    with hosted(ServerSettings(folder, keys=KEYS)) as server:
        tab.open(f"{server.address}?token={token}", width=640, height=480)
        pictures = "performance.getEntriesByType('resource').filter(one => one.responseStatus === 200).length"
        tab.wait_for(f"{pictures} === 2")
        assert not tab.complaints
        # Later: a page that is left while it answers gives no answer.
        tab.evaluate("setTimeout(() => document.querySelector('a[href*=\"ball.sgs\"]').click()), 1")
        tab.wait_for(SHOWN)
        asked = [address for address in tab.requests if address.startswith("http") and "player.js" not in address]
        answers = server.ask("/metrics", Authorization=f"Bearer {token}").body.decode()
    # The player's worker asks for the bytes; no request lacked the token.
    assert answered(answers, "file", "ball.sgs")
    assert 'status="401"' not in answers
    assert all(f"token={token}" in address for address in asked)
    assert all(address.startswith(server.address) for address in asked)
    assert not tab.complaints


def test_a_page_switches_between_the_qualities_of_a_stream(tab: Tab, tmp_path: Path) -> None:
    """By hand, in the panel, with a token of that stream alone; these two qualities show different scenes."""
    folder = tmp_path / "streams"
    for name, seed in (("low", 4), ("high", 9)):
        sink = MemorySink()
        scenes = [moved(random_scene(60, seed=seed), step) for step in range(6)]
        write_stream(sink, scenes, header=compact_header(scenes[0]))
        GrowingFolder(folder / "show" / name, sink.data).write_all()
    listed = [ListedQuality(name, f"{name}/manifest.json", bits) for name, bits in (("low", 1e6), ("high", 1e12))]
    write_list(folder / "show", listed)
    player = 'document.querySelector("structgstream-player")'
    panel = f"{player}.shadowRoot.querySelector('[aria-label^=Picture]')"
    found = f"[...{player}.shadowRoot.querySelectorAll('select')].find((one) => one.innerText.includes('high'))"
    soon = int(time.time()) + 600
    token, all_streams = (KEYS.token(name, expires_unix_seconds=soon) for name in ("show", EVERY_STREAM))

    def shown(frame: int) -> np.ndarray:
        """What a frame looks like."""
        hidden = f"{player}.setAttribute('controls', 'off')"
        tab.evaluate(f"{player}.pause(), {hidden}, {player}.seek({frame + 0.5} / 30), 1")
        tab.wait_for(f"{SHOWN} && {player}.stats.frameIndex === {frame}")
        return tab.screenshot().astype(float)

    def numbers() -> str:
        return server.ask("/metrics", Authorization=f"Bearer {all_streams}").body.decode()

    with hosted(ServerSettings(folder, keys=KEYS)) as server:
        tab.open(f"{server.address}streams/show/?token={token}", width=360, height=240)
        tab.wait_for(SHOWN)
        low = shown(2)
        assert answered(numbers(), "segment", "show/low")
        assert not answered(numbers(), "segment", "show/high"), "no connection has this bit rate"
        tab.evaluate(f"{player}.removeAttribute('controls'), {panel}.click(), 1")
        assert tab.wait_for(f"{found}?.innerText").split() == ["automatic", "low", "high"]
        tab.evaluate(f"((one) => {{ one.value = '1'; one.dispatchEvent(new Event('change')); }})({found}), 1")
        tab.evaluate(f"{panel}.click(), {player}.seek(0.01), {player}.play(), 1")
        tab.wait_for(f"{player}.stats.frameIndex >= 4")
        high, last = shown(2), time.monotonic() + 20
        while np.array_equal(high, low) and time.monotonic() < last:  # A busy machine has not fetched it yet.
            tab.evaluate(f"{player}.seek(0.01), 1")
            high = shown(2)
        reported = numbers()
    assert answered(reported, "segment", "show/high")
    assert 'status="401"' not in reported
    assert np.abs(low - high).mean() > 5
    assert not tab.complaints
