# SPDX-License-Identifier: Apache-2.0
"""Servers and trainers that are killed while viewers watch, for ``faults``.

What stands for the trainer writes prepared packets as segments, one in :data:`PACE_SECONDS`. Viewers are players
without a picture, which check every byte (``load_players``), and one page in Chromium, which is never loaded again.
"""

import os
import random
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

from lab.robustness.fault_players import Players
from lab.robustness.load import digests
from lab.robustness.load_fetch import free_port
from lab.robustness.stream_writers import Sent, content, edge_of, renumbered
from structgstream.codec.packets import PacketSink
from structgstream.codec.segments.sink import SegmentsOptions
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.sinks import MemorySink, resume_segments

PACE_SECONDS = 0.1
NAME = "live"
PATIENCE_SECONDS = 300.0  # many programs may share the machine
NUMBER = struct.Struct("<I")
LISTEN = """(() => {
  const player = document.querySelector("structgstream-player");
  if (!player?.on) return false;
  window.heard = { shown: -1, last: -1, back: [], errors: [], notices: {} };
  player.on("drawn", ({ stats }) => {
    if (player.live && stats.frameIndex < heard.last) heard.back.push([heard.last, stats.frameIndex]);
    heard.last = stats.frameIndex ?? heard.last;
    heard.shown = Math.max(heard.shown, heard.last); // the page plays a stream that has ended again from its beginning
  });
  player.on("error", ({ message }) => heard.errors.push(message));
  player.on("notice", ({ message }) => { heard.notices[message] = (heard.notices[message] ?? 0) + 1; });
  return true;
})()"""


@dataclass
class ViewerRow:
    """A kind of kill, at many moments.

    Attributes:
        kills: how many.
        seed: of their moments.
        frames: of the stream in the end.
        borders: kills after which the next frame is the first of a period.
        reported_frames_lost: that were reported as written and not there after a kill.
        equal: whether the stream has the bytes of one that was never interrupted.
        players: that check bytes.
        exact: of them, those that had every frame with the right bytes in the end.
        broken: their connections that ended in the middle.
        seconds_until_normal: from when the server answers again, or the trainer is killed, until every player has a
            frame that is newer than the kill.
        page_seconds_until_normal: the same, until the page in Chromium showed one.
        page_errors: what the page told as an error.
        page_went_back: from which frame to which, while the stream was live.
        page_notices: what else it told, and how often.
    """

    what: str
    kills: int = 0
    seed: int = 0
    frames: int = 0
    borders: int = 0
    reported_frames_lost: int = 0
    equal: bool = False
    players: int = 0
    exact: int = 0
    broken: int = 0
    seconds_until_normal: list[float] = field(default_factory=list)
    page_seconds_until_normal: list[float] = field(default_factory=list)
    page_errors: list[str] = field(default_factory=list)
    page_went_back: list[tuple[int, int]] | None = None
    page_notices: dict[str, int] = field(default_factory=dict)


class Trainer:
    """A process that goes on with a stream, until it is told to end or killed; ``life`` is given where it reports."""

    def __init__(self, life: Callable[[int], object]) -> None:
        reading, writing = os.pipe()
        self._process = os.fork()
        if not self._process:
            os.close(reading)
            life(writing)
        os.close(writing)
        os.set_blocking(reading, False)
        self._reading, self._reported, self._ended = reading, -1, False

    def reported(self) -> int:
        """The last frame that it reported as written; -1 without any."""
        try:
            while data := os.read(self._reading, NUMBER.size):
                self._reported = NUMBER.unpack(data)[0]
        except BlockingIOError:
            pass
        return self._reported

    def end(self, how: signal.Signals | None) -> int:
        """Ends it, if it has not been, or without a signal waits for its end; the last frame that it reported."""
        if self._ended:
            return self._reported
        self._ended = True
        if how is not None:
            os.kill(self._process, how)
        os.waitpid(self._process, 0)
        found = self.reported()
        os.close(self._reading)
        return found


class Trainers:
    """One trainer after the other."""

    def __init__(self, life: Callable[[int], object]) -> None:
        self._life = life
        self._one = Trainer(life)

    def start(self) -> None:
        """Another one goes on with the stream."""
        self._one = Trainer(self._life)

    def reported(self) -> int:
        """The last frame that the present one reported."""
        return self._one.reported()

    def end(self, how: signal.Signals | None) -> int:
        """Ends the present one, or waits for its end; the last frame that it reported."""
        return self._one.end(how)


def _write(folder: Path, sent: Sent, writing: int) -> None:
    """The life of a trainer's process."""
    ended = False

    def end(*signal_and_frame: Any) -> None:
        nonlocal ended
        ended = True

    status = 1
    try:
        signal.signal(signal.SIGTERM, end)
        sink, resumed = resume_segments(FolderStore(folder), options=SegmentsOptions(grace_seconds=30.0))
        sink.open(sent.header)
        for index in count(0 if resumed is None else len(resumed)):
            if ended:
                break
            _send(sink, sent, index)
            os.write(writing, NUMBER.pack(index))
            time.sleep(PACE_SECONDS)
        sink.close()
        status = 0
    finally:
        os._exit(status)


def _send(sink: PacketSink, sent: Sent, index: int) -> None:
    if sent.begins_period(index):
        sink.begin(sent.header)
    sink.write(renumbered(sent.packets[index % len(sent.packets)], index, fps=sent.header.fps))


class Server:
    """``structgstream serve`` on a port that stays the same."""

    def __init__(self, folder: Path) -> None:
        self._command = [sys.executable, "-m", "structgstream", "serve", str(folder), "--port", str(free_port())]
        self._running: subprocess.Popen[str] | None = None

    def start(self) -> str:
        """Starts it; its address, once it answers."""
        command = self._command
        self._running = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self._running.stdout is not None
        line = self._running.stdout.readline()
        assert "http://" in line, "the server tells its address"
        return "http://" + line.split("http://", 1)[1].split()[0]

    def kill(self) -> None:
        """Ends it at once."""
        assert self._running is not None
        self._running.kill()
        self._running.communicate()
        self._running = None

    def close(self) -> None:
        """Ends it, if it runs."""
        if self._running is not None:
            self.kill()


class Page:
    """The served page in Chromium."""

    def __init__(self, tab: Any, address: str) -> None:
        self._tab = tab
        tab.open(f"{address}streams/{NAME}/", width=160, height=120)
        tab.wait_for(LISTEN)
        tab.wait_for("heard.shown >= 0")

    @property
    def shown(self) -> int:
        """The newest frame that was drawn."""
        return self._tab.evaluate("heard.shown")

    def note(self, row: ViewerRow) -> None:
        """What it went through."""
        heard = self._tab.evaluate("heard")
        row.page_errors, row.page_went_back, row.page_notices = heard["errors"], heard["back"], heard["notices"]


@contextmanager
def watched(
    folder: Path, life: Callable[[int], object], *, players: int, page: bool
) -> Iterator[tuple[Server, Trainers, Players, Any]]:
    """A trainer at work, a server, and who watches."""
    stream = folder / "streams" / NAME
    FolderStore(stream).prepare()
    with ExitStack() as stack:
        trainers = Trainers(life)
        stack.callback(trainers.end, signal.SIGKILL)
        wait_until(lambda: (stream / "manifest.json").exists())
        server = Server(folder / "streams")
        stack.callback(server.close)
        address = server.start()
        watching = stack.enter_context(Players(f"{address}streams/{NAME}/", players))
        wait_until(lambda: watching.least_frames() > 0)
        shown = None
        if page:
            from tests.support.chromium import opened_browser  # which needs pytest

            (folder / "browser").mkdir()
            browser = stack.enter_context(opened_browser(folder / "browser"))
            shown = Page(stack.enter_context(browser.opened_tab()), address)
        yield server, trainers, watching, shown


def killed_servers(
    sent: Sent, *, kills: int, seed: int, folder: Path, players: int, page: bool, down_seconds: float
) -> ViewerRow:
    """The server is killed at random moments, and started again after up to ``down_seconds``."""
    row, rng = ViewerRow("server", seed=seed, players=players), random.Random(f"server {seed}")
    life = partial(_write, folder / "streams" / NAME, sent)
    with watched(folder, life, players=players, page=page) as (server, trainers, watching, shown):
        for _ in range(kills):
            time.sleep(rng.uniform(0.0, 1.0))
            server.kill()
            edge = trainers.reported()
            time.sleep(rng.uniform(0.0, down_seconds))
            server.start()
            began = time.monotonic()
            wait_for_viewers(row, began, edge, watching, shown)
        row.frames = trainers.end(signal.SIGTERM) + 1
        finish(row, _whole(sent, row.frames), watching, shown, folder)
    return row


def killed_trainers(sent: Sent, *, kills: int, seed: int, folder: Path, players: int, page: bool) -> ViewerRow:
    """The trainer is killed at random moments, in a stream of periods near their borders; another goes on at once."""
    what = "trainer across periods" if sent.begins else "trainer"
    row, rng = ViewerRow(what, seed=seed, players=players), random.Random(f"{what} {seed}")
    stream = folder / "streams" / NAME
    with watched(folder, partial(_write, stream, sent), players=players, page=page) as (_, trainers, watching, shown):
        for _ in range(kills):
            time.sleep(rng.uniform(0.05, 1.0))
            if sent.begins:
                wait_until(lambda: sent.begins_period(trainers.reported() + 2))
                time.sleep(rng.uniform(0.0, 2.0 * PACE_SECONDS))
            reported = trainers.end(signal.SIGKILL)
            began, edge = time.monotonic(), edge_of(stream)
            row.reported_frames_lost += max(reported - edge, 0)
            row.borders += sent.begins_period(edge + 1)
            trainers.start()
            wait_for_viewers(row, began, edge, watching, shown)
        row.frames = trainers.end(signal.SIGTERM) + 1
        finish(row, _whole(sent, row.frames), watching, shown, folder)
    return row


def wait_for_viewers(row: ViewerRow, began: float, edge: int, watching: Players, shown: Page | None) -> None:
    """Notes when all players have a frame after ``edge``, and when the page shows one."""
    row.kills += 1
    wait_until(lambda: watching.least_frames() > edge + 1)
    row.seconds_until_normal.append(time.monotonic() - began)
    if shown is not None:
        wait_until(lambda: shown.shown > edge)
        row.page_seconds_until_normal.append(time.monotonic() - began)


def _whole(sent: Sent, frames: int) -> bytes:
    """The stream's bytes, had it not been interrupted."""
    sink = MemorySink()
    sink.open(sent.header)
    for index in range(frames):
        _send(sink, sent, index)
    sink.close()
    return sink.data


def finish(row: ViewerRow, whole: bytes, watching: Players, shown: Page | None, folder: Path) -> None:
    """The stream has ended; compares it with one that was never interrupted, and with what the viewers have."""
    stream = folder / "streams" / NAME
    row.reported_frames_lost += max(row.frames - 1 - edge_of(stream), 0)
    row.equal = content(stream, beside=folder) == whole
    found = watching.ended(PATIENCE_SECONDS)
    right = digests(stream).get(row.frames)
    row.exact = sum(one.frames == row.frames and one.digest == right and not one.wrong for one in found)
    row.broken = sum(one.broken for one in found)
    if shown is not None:
        shown.note(row)  # that it went on was seen after each kill; a busy one may drop the last frame


def wait_until(true: Callable[[], bool]) -> None:
    """Waits for a condition.

    Raises:
        TimeoutError: it did not come true.
    """
    last = time.monotonic() + PATIENCE_SECONDS
    while not true():
        if time.monotonic() > last:
            raise TimeoutError(f"not within {PATIENCE_SECONDS:g} s")
        time.sleep(0.02)
