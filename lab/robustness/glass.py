# SPDX-License-Identifier: Apache-2.0
"""From a picture that is filmed to one that is shown: cameras, trainer, server and player on this machine, by stage.

    python -m lab.robustness.glass build/glass --minutes 16 --json lab/results/glass.json
    python -m lab.robustness.glass table lab/results/glass.json
    python -m lab.robustness.glass plot lab/results/glass.json docs/images/glass.png

Ten cameras (``tests/support/senders/send.py``, the bundled clip, 320x240) are reconstructed live with segments, served
by ``structgstream serve`` and played in Chromium (which needs pytest, as the browser is that of the tests). Filmed,
arrived, matched, handed over and written are told by the run's log and the manifests; fetched, decoded and shown by the
page. All clocks are this machine's. With RTSP *filmed* is the least of the arrivals of late. What follows ``--`` goes
to ``structgstream reconstruct``. A result is added to those of the JSON file.
"""

import argparse
import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from benchmarks.machine import load_average, machine
from lab.robustness.glass_frames import frames_of
from lab.robustness.glass_report import plot, table
from lab.robustness.load import Watched, processor_seconds, serving

ROOT = Path(__file__).parents[2]
NAME = "now"
PATIENCE_SECONDS = 240.0
PULL_SECONDS = 5.0
FIRST_ITERATIONS = "200"
TRAINING = (
    "--preset", "fast", "--initial.iterations", FIRST_ITERATIONS, "--initial.schedule-iterations", FIRST_ITERATIONS,
    "--initial.coarse-iterations", "120", "--online.iterations", "20",
)  # fmt: skip
WATCH = """(() => {
  const heard = (globalThis.heard = { events: [], errors: [], notices: [] });
  const now = () => performance.timeOrigin + performance.now();
  const note = (kind, frame) => heard.events.push([kind, frame, now() / 1000]);
  globalThis.Worker = class extends globalThis.Worker {
    constructor(...given) {
      super(...given);
      this.addEventListener("message", ({ data }) => {
        if (data?.type === "catalog") note("known", data.facts.count - 1);
        else if (data?.type === "stored") note("fetched", Math.max(-1, ...data.ranges.map(([, end]) => end - 1)));
        else if (data?.type === "frame") note("decoded", data.update.index);
      });
    }
  };
  const listen = () => {
    const player = document.querySelector("structgstream-player");
    if (!player?.on) return void setTimeout(listen, 20);
    let last = -1;
    player.on("drawn", ({ stats }) => {
      if (stats.frameIndex === undefined || stats.frameIndex === last) return;
      last = stats.frameIndex;
      note("drawn", last);
      // The next picture but one is begun when this one is on the screen.
      requestAnimationFrame(() => requestAnimationFrame(() => note("shown", stats.frameIndex)));
    });
    player.on("error", ({ message }) => heard.errors.push(message));
    player.on("notice", ({ message }) => heard.notices.push(message));
  };
  listen();
})()"""
PULL = (
    "(() => { const found = { ...heard }; heard.events = []; heard.errors = []; heard.notices = []; return found; })()"
)


@contextmanager
def sending(folder: Path, *options: str) -> Iterator[None]:
    """The cameras, until the end of the block."""
    command = [sys.executable, str(ROOT / "tests" / "support" / "senders" / "send.py"), str(folder), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        try:
            running.stdout.readline()
            yield
        finally:
            running.kill()


@contextmanager
def training(folder: Path, *options: str) -> Iterator["subprocess.Popen[bytes]"]:
    """The trainer, until the end of the block, where it is told to finish its frame."""
    command = [sys.executable, "-m", "structgstream", "reconstruct", str(folder / "rig" / "rig.toml")]
    with (folder / "reconstruct.log").open("wb") as log:
        running = subprocess.Popen(
            [*command, "-o", str(folder / "streams" / NAME), "--sink", "segments", "--live", *options],
            stdout=log,
            stderr=log,
        )
        try:
            yield running
        finally:
            if running.poll() is None:
                running.send_signal(signal.SIGTERM)
            running.wait(PATIENCE_SECONDS)


class Page:
    """The served page in Chromium, and what it has told."""

    def __init__(self, tab: Any, address: str) -> None:
        self._tab = tab
        tab._call("Page.addScriptToEvaluateOnNewDocument", source=WATCH)
        tab.open(f"{address}streams/{NAME}/", width=640, height=360)
        self.events: list[tuple[str, int, float]] = []
        self.errors: list[str] = []
        self.notices: list[str] = []

    def pull(self) -> None:
        """Takes what has been told since."""
        found = self._tab.evaluate(PULL)
        self.events += [(stage, frame, at) for stage, frame, at in found["events"] if frame is not None]
        self.errors += found["errors"]
        self.notices += found["notices"]


class Edges:
    """When each frame was filmed and published, from the manifests."""

    def __init__(self, manifest: Path) -> None:
        self._manifest = manifest
        self.found: dict[int, dict[str, float]] = {}

    def look(self) -> None:
        """Reads the manifest."""
        edge = json.loads(self._manifest.read_bytes())["edge"]
        self.found.setdefault(edge["frame"], edge)


def measured(folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """One run."""
    from tests.support.chromium import opened_browser  # which needs pytest

    before = load_average()
    (folder / "streams").mkdir(parents=True)
    with ExitStack() as stack:
        stack.enter_context(sending(folder / "rig", "--transport", options.transport, "--fps", str(options.fps)))
        reconstruct = (*TRAINING, *options.training)
        trainer = stack.enter_context(training(folder, *reconstruct))
        began = time.monotonic()
        manifest = folder / "streams" / NAME / "manifest.json"
        while not manifest.exists():
            assert trainer.poll() is None, (folder / "reconstruct.log").read_text()
            assert time.monotonic() - began < PATIENCE_SECONDS, "frame 0 takes too long"
            time.sleep(0.1)
        first_after = time.monotonic() - began
        address, server = stack.enter_context(serving(folder / "streams", nice=options.server_nice))
        memory = [stack.enter_context(Watched(process)) for process in (trainer.pid, server)]
        (folder / "browser").mkdir()
        browser = stack.enter_context(opened_browser(folder / "browser"))
        page = Page(stack.enter_context(browser.opened_tab()), address)
        edges = Edges(manifest)
        _watch(edges, page, 60.0 * options.minutes)
        busy = {"trainer": processor_seconds(trainer.pid), "server": processor_seconds(server)}
        assert trainer.poll() is None, (folder / "reconstruct.log").read_text()
    entries = [json.loads(line) for line in (folder / "streams" / f"{NAME}.log.jsonl").read_text().splitlines()]
    return {
        "transport": options.transport,
        "fps": options.fps,
        "minutes": options.minutes,
        "training": list(reconstruct),
        "first_frame_seconds": first_after,
        "frames": frames_of(entries, edges.found, page.events),
        "sets": entries[-1]["run"]["live"]["sets"],
        "skipped_sets": entries[-1]["run"]["live"]["skipped_sets"],
        "errors": page.errors,
        "notices": page.notices,
        "busy_seconds": busy,
        "memory": {
            name: [(round(at - began, 1), size) for at, size in one.samples[::4]]
            for name, one in zip(("trainer", "server"), memory, strict=True)
        },
        "machine": machine(),
        "load_average": {"before": before, "after": load_average()},
    }


def _watch(edges: Edges, page: Page, seconds: float) -> None:
    last = time.monotonic() + seconds
    pull = 0.0
    while time.monotonic() < last:
        edges.look()
        if time.monotonic() > pull:
            page.pull()
            pull = time.monotonic() + PULL_SECONDS
        time.sleep(0.1)
    page.pull()


def parsed(arguments: list[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m lab.robustness.glass", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="is made; the stream and its log stay there")
    parser.add_argument("--transport", choices=("udp", "tcp", "http", "rtsp"), default="http")
    parser.add_argument("--fps", type=float, default=10.0, help="pictures a second of each camera")
    parser.add_argument("--minutes", type=float, default=16.0, help="after frame 0")
    parser.add_argument("--server-nice", type=int, default=5)
    parser.add_argument("--json", type=Path, metavar="FILE")
    end = arguments.index("--") if "--" in arguments else len(arguments)
    return parser.parse_args(arguments[:end], argparse.Namespace(training=arguments[end + 1 :]))


def main() -> None:
    """Measures, or shows results."""
    if sys.argv[1:2] == ["table"]:
        print(table(json.loads(Path(sys.argv[2]).read_text())))
        return
    if sys.argv[1:2] == ["plot"]:
        plot(json.loads(Path(sys.argv[2]).read_text())[0], Path(sys.argv[3]))
        return
    options = parsed(sys.argv[1:])
    result = {"command": re.sub(r"\s+", " ", " ".join(["python -m lab.robustness.glass", *sys.argv[1:]]))}
    result |= measured(options.folder, options)
    there = json.loads(options.json.read_text()) if options.json and options.json.exists() else []
    if options.json:
        options.json.write_text(json.dumps([*there, result], indent=1) + "\n")
    print(table([result]))


if __name__ == "__main__":
    main()
