# SPDX-License-Identifier: Apache-2.0
"""What this package makes of the player, in a real browser: the page, the served pages, the site, the widget.

The player itself is tested in ``viewer/packages``.
"""

import base64
import re
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.codec.reader import open_stream
from structgstream.codec.segments.quality_list import ListedQuality, write_list
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.sinks import MemorySink, resume_segments
from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.data.open import open_capture
from structgstream.evaluation.evaluate import rendered
from structgstream.evaluation.pictures import png_bytes
from structgstream.exporters.write import write_gaussians
from structgstream.kernels.backend import reference_backend
from structgstream.notebook import Player
from structgstream.sequence_import import import_sequence
from structgstream.serve.access import EVERY_STREAM, TokenKeys
from structgstream.serve.app import ServerSettings
from structgstream.serve.pages import StreamFile, bundle, linked_page, write_page, write_site
from structgstream.serve.play import Truth
from tests.support.chromium import Browser, Tab, opened_browser
from tests.support.pictures import decoded_picture
from tests.support.plain import some
from tests.support.rigs import arc_rig, random_scene
from tests.support.segment_folders import GrowingFolder
from tests.support.serving import free_port, hosted, nginx, served
from tests.support.streams import compact_header, moved, write_stream

DOCS = Path(__file__).parents[2] / "docs"
FRAMES = 6
WIDTH, HEIGHT = 240, 160  # The cameras' own shape, larger.
PLAYER = 'document.querySelector("structgstream-player")'
SHOWN = f"{PLAYER}?.stats?.settled"


def made_stream(seed: int = 4) -> bytes:
    """Some hundred splats that move, a key packet at every third frame."""
    sink = MemorySink()
    scenes = [moved(random_scene(60, seed=seed), step) for step in range(FRAMES)]
    write_stream(sink, scenes, header=compact_header(scenes[0]))
    return sink.data


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("stream") / "small.sgs"
    path.write_bytes(made_stream())
    return path


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with opened_browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.fixture
def tab(browser: Browser) -> Iterator[Tab]:
    with browser.opened_tab() as opened:
        yield opened


def paused_at(tab: Tab, frame: int) -> None:
    """Shows one frame and nothing but the picture."""
    tab.wait_for(SHOWN)
    tab.evaluate(f"{PLAYER}.pause(), {PLAYER}.setAttribute('controls', 'off'), {PLAYER}.seek({frame + 0.5} / 30), 1")
    tab.wait_for(f"{SHOWN} && {PLAYER}.stats.frameIndex === {frame}")


def check_picture(tab: Tab, stream: Path, frame: int, *, whole_page: bool = False) -> None:
    """Looks at the frame that is shown through the first training camera; Python renders the same."""
    tab.evaluate(f"{PLAYER}.show({PLAYER}.cameras[1]), new Promise(requestAnimationFrame)")
    tab.wait_for(SHOWN)
    picture = tab.screenshot() if whole_page else canvas_of(tab)
    reader = open_stream(stream)
    camera = reader.header.camera(reader.header.rig.training[0])
    wanted, _ = rendered(reader.scene(frame), camera.resized(WIDTH, HEIGHT), reference_backend())
    assert picture.shape == wanted.shape
    assert wanted.std() > 20, "something is there to be seen"
    assert 10 * np.log10(255**2 / float(np.square(picture.astype(float) - wanted).mean())) > 40


def canvas_of(tab: Tab) -> NDArray[np.uint8]:
    """The picture alone, without what the player says above it."""
    png = tab.evaluate(
        f"""{PLAYER}.screenshot().then((blob) => new Promise((resolve) => {{
          const reader = new FileReader();
          reader.onload = () => resolve(reader.result);
          reader.readAsDataURL(blob);
        }}))"""
    )
    return decoded_picture(base64.b64decode(png.split(",")[1]))


def test_a_page_opens_from_the_disk(tab: Tab, stream: Path, tmp_path: Path) -> None:
    page = tmp_path / "page #1.html"
    write_page(page, StreamFile(stream))
    tab.open(page.as_uri(), width=WIDTH, height=HEIGHT)
    paused_at(tab, 4)
    check_picture(tab, stream, 4, whole_page=True)
    assert tab.evaluate(f"{PLAYER}.duration") == pytest.approx(FRAMES / 30)
    assert not tab.complaints
    assert {address.split(":")[0] for address in tab.requests} <= {"file", "blob", "data"}


def test_an_imported_sequence_plays(tab: Tab, tmp_path: Path) -> None:
    """A stream without anchors: free Gaussians only."""
    parts = [replace(some(200), means=some(200).means + 0.1 * t) for t in range(3)]
    files = [write_gaussians(tmp_path / f"frame_{t}.ply", part, format="ply") for t, part in enumerate(parts)]
    stream, page = tmp_path / "imported.sgs", tmp_path / "page.html"
    import_sequence(files, stream, fps=30.0, backend=reference_backend(), rig=arc_rig())
    write_page(page, StreamFile(stream))
    tab.open(page.as_uri(), width=WIDTH, height=HEIGHT)
    for frame in (2, 0):
        paused_at(tab, frame)
        check_picture(tab, stream, frame, whole_page=True)
    assert not tab.complaints


def test_the_server_plays_and_compares_and_follows(tab: Tab, stream: Path, tmp_path: Path) -> None:
    whole = stream.read_bytes()
    packets = open_stream(stream).packets
    growing = tmp_path / "growing.sgs"
    growing.write_bytes(whole[: packets[2].offset])
    source = open_capture(bundled_clip_path(), frames=2)
    with served(StreamFile(growing), truth=Truth(source, ("cam01", "cam02"))) as server:
        tab.open(server.address, width=WIDTH, height=HEIGHT)
        tab.wait_for(f"{SHOWN} && {PLAYER}.stats.frameIndex === 1")
        growing.write_bytes(whole)
        tab.wait_for(f"{PLAYER}.stats.frameIndex > 1")
        paused_at(tab, 5)
        check_picture(tab, stream, 5)
        assert not tab.complaints
        assert all(address.startswith((server.address, "blob:", "data:")) for address in tab.requests)
        assert f"{server.address}truth.json" in tab.requests


def test_a_site_plays_from_a_server_that_knows_nothing(tab: Tab, stream: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    write_site(site, StreamFile(stream))
    with python_host(site) as address:
        tab.open(address, width=WIDTH, height=HEIGHT)
        paused_at(tab, 3)
        check_picture(tab, stream, 3)
    assert not tab.complaints


def test_a_site_that_is_opened_from_the_disk_says_what_it_needs(tab: Tab, stream: Path, tmp_path: Path) -> None:
    write_site(tmp_path / "site", StreamFile(stream))
    tab.open((tmp_path / "site" / "index.html").as_uri(), width=WIDTH, height=HEIGHT)
    style = f"getComputedStyle({PLAYER}, '::before')"
    tab.wait_for(f"{PLAYER} && {style}.visibility === 'visible'")
    assert "put its folder on a web server" in tab.evaluate(f"{style}.content")
    tab.complaints.clear()


@contextmanager
def python_host(root: Path) -> Iterator[str]:
    """The standard library's server of files."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(root))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()


@contextmanager
def documented_nginx(root: Path) -> Iterator[str]:
    """nginx with the configuration of docs/segments.md."""
    (work := root.parent / "nginx").mkdir()
    documented = (DOCS / "segments.md").read_text().split("```nginx\n")[1].split("```")[0]
    site = documented.replace("root /srv;", f"root {root};")
    page = f"location / {{ root {root}; types {{ text/html html; text/javascript js; }} }}"
    port = free_port()
    with nginx(work, port, f"access_log off; server {{ listen 127.0.0.1:{port}; {page}\n{site} }}") as running:
        yield running.address


def test_segments_play_from_a_host_of_files_while_they_are_written(tab: Tab, stream: Path, tmp_path: Path) -> None:
    root, reader = tmp_path / "root", open_stream(stream)
    store = FolderStore(root / "streams" / "live")
    store.prepare()
    sink, _ = resume_segments(store)
    sink.open(reader.header)
    packets = [[*reader.group(index)][-1] for index in range(FRAMES)]
    for packet in packets[:2]:
        sink.write(packet)
    page = linked_page("live", stream="streams/live/manifest.json", attributes={"autoplay": ""})
    (root / "index.html").write_text(page)
    (root / "player.js").write_text(bundle(), encoding="utf-8")
    with (documented_nginx if shutil.which("nginx") else python_host)(root) as address:
        tab.open(f"{address}index.html", width=WIDTH, height=HEIGHT)
        tab.wait_for(f"{SHOWN} && {PLAYER}.stats.frameIndex === 1 && {PLAYER}.live")
        for packet in packets[2:4]:  # the first of them is a key, so that a segment is closed
            sink.write(packet)
            tab.wait_for(f"{SHOWN} && {PLAYER}.stats.frameIndex === {packet.index}")
        sink.close()
        tab.wait_for(f"{PLAYER}.live === false")
        again, _ = resume_segments(store)
        again.open(reader.header)
        for packet in packets[4:]:
            again.write(packet)
        tab.wait_for(f"{SHOWN} && {PLAYER}.live && {PLAYER}.stats.frameIndex === {FRAMES - 1}")
        again.close()
        check_picture(tab, stream, FRAMES - 1)
    assert not tab.complaints


class Quiet(SimpleHTTPRequestHandler):
    """A server of files, without ranges, that writes no log."""

    def log_message(self, format: str, *args: object) -> None:
        """Says nothing."""


def test_the_widget_shows_a_stream_and_another_and_goes(tab: Tab, stream: Path, tmp_path: Path) -> None:
    widget = Player(stream, height_pixels=HEIGHT)
    module = base64.b64encode(str(widget.get_state()["_esm"]).encode()).decode()
    data = base64.b64encode(widget.stream).decode()
    (tmp_path / "empty.html").write_text('<!doctype html><link rel="icon" href="data:,"><style>body{margin:0}</style>')
    tab.open((tmp_path / "empty.html").as_uri(), width=WIDTH, height=HEIGHT)
    tab.evaluate(
        f"""(async () => {{
          const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
          const url = URL.createObjectURL(new Blob([bytes("{module}")], {{ type: "text/javascript" }}));
          const listeners = globalThis.listeners = new Map();
          const stream = new DataView(bytes("{data}").buffer);
          const values = globalThis.values = {{ stream, height_pixels: {HEIGHT} }};
          const model = {{
            get: (name) => values[name],
            on: (name, listener) => listeners.set(name, listener),
            off: (name, listener) => listeners.get(name) === listener && listeners.delete(name),
          }};
          const el = document.createElement("div");
          const again = document.createElement("div");
          const widget = (await import(url)).default;
          globalThis.end = await widget.render({{ model, el }});
          await (await import(url + "#again")).default.render({{ model: {{ ...model, on() {{}} }}, el: again }});
          await new Promise((resolve) => setTimeout(resolve, 100));
          document.body.append(el); // a notebook may put it into the page later
        }})()"""
    )
    paused_at(tab, 2)
    check_picture(tab, stream, 2)
    tab.evaluate(f"{PLAYER}.seek(0), listeners.get('change:stream')(), 1")
    tab.wait_for(f"{SHOWN} && {PLAYER}.stats.frameIndex === 0")
    tab.evaluate("values.height_pixels = 100, listeners.get('change:height_pixels')(), 1")
    assert tab.evaluate(f"{PLAYER}.getBoundingClientRect().height") == 100
    assert tab.evaluate(f"end(), {PLAYER} === null && listeners.size === 0")
    assert not tab.complaints


KEYS = TokenKeys((b"a secret of thirty-two characters",))


def answered(metrics: str, kind: str, stream: str) -> bool:
    """Whether the server has sent files of a kind."""
    sample = rf'structgstream_requests_total{{kind="{kind}",status="20.",stream="{stream}"}}'
    return re.search(sample, metrics) is not None


@pytest.fixture
def folder(tmp_path: Path, stream: Path) -> Path:
    streams = tmp_path / "streams"
    GrowingFolder(streams / "studio", stream.read_bytes()).write()
    (streams / "ball.sgs").write_bytes(stream.read_bytes())
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
        answers = server.ask("/metrics", Authorization=f"Bearer {token}").text
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
        GrowingFolder(folder / "show" / name, made_stream(seed)).write_all()
    listed = [ListedQuality(name, f"{name}/manifest.json", bits) for name, bits in (("low", 1e6), ("high", 1e12))]
    write_list(folder / "show", listed)
    panel = f"{PLAYER}.shadowRoot.querySelector('[aria-label^=Picture]')"
    found = f"[...{PLAYER}.shadowRoot.querySelectorAll('select')].find((one) => one.innerText.includes('high'))"
    soon = int(time.time()) + 600
    token, all_streams = (KEYS.token(name, expires_unix_seconds=soon) for name in ("show", EVERY_STREAM))

    def shown(frame: int) -> np.ndarray:
        """What a frame looks like."""
        paused_at(tab, frame)
        return tab.screenshot().astype(float)

    def numbers() -> str:
        return server.ask("/metrics", Authorization=f"Bearer {all_streams}").text

    with hosted(ServerSettings(folder, keys=KEYS)) as server:
        tab.open(f"{server.address}streams/show/?token={token}", width=360, height=240)
        tab.wait_for(SHOWN)
        low = shown(2)
        assert answered(numbers(), "segment", "show/low")
        assert not answered(numbers(), "segment", "show/high"), "no connection has this bit rate"
        tab.evaluate(f"{PLAYER}.removeAttribute('controls'), {panel}.click(), 1")
        assert tab.wait_for(f"{found}?.innerText").split() == ["automatic", "low", "high"]
        tab.evaluate(f"((one) => {{ one.value = '1'; one.dispatchEvent(new Event('change')); }})({found}), 1")
        tab.evaluate(f"{panel}.click(), {PLAYER}.seek(0.01), {PLAYER}.play(), 1")
        tab.wait_for(f"{PLAYER}.stats.frameIndex >= 4")
        high, last = shown(2), time.monotonic() + 20
        while np.array_equal(high, low) and time.monotonic() < last:  # A busy machine has not fetched it yet.
            tab.evaluate(f"{PLAYER}.seek(0.01), 1")
            high = shown(2)
        reported = numbers()
    assert answered(reported, "segment", "show/high")
    assert 'status="401"' not in reported
    assert np.abs(low - high).mean() > 5
    assert not tab.complaints
