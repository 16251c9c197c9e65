# SPDX-License-Identifier: Apache-2.0
"""A real browser for tests: Chromium without a window, spoken to through a pipe (the DevTools protocol).

The pipe needs nothing but the standard library: each message is JSON that ends with a zero byte.
"""

import base64
import fcntl
import json
import os
import select
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.support.pictures import decoded_picture

ROOT = Path(__file__).parents[2]
PATIENCE_SECONDS = 90.0
# WebGL2 in software, wherever this runs; root may not use the sandbox.
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--no-first-run",
    "--disable-background-networking",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-gpu-compositing",
    "--disable-gpu-rasterization",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)


class Browser:
    """A running browser; its messages go through two pipes."""

    def __init__(self, inlet: int, outlet: int) -> None:
        self._inlet, self._outlet, self._buffer, self._number = inlet, outlet, b"", 0

    @contextmanager
    def opened_tab(self) -> Iterator["Tab"]:
        """An empty page with cookies, storage and a cache of its own."""
        context = self.call("Target.createBrowserContext")["browserContextId"]
        target = self.call("Target.createTarget", url="about:blank", browserContextId=context)["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        yield Tab(self, session)
        self.call("Target.disposeBrowserContext", browserContextId=context)

    def call(
        self,
        method: str,
        *,
        session: str | None = None,
        on_event: Callable[[str, Mapping[str, Any]], None] | None = None,
        **parameters: object,
    ) -> dict[str, Any]:
        """The result of a method of the browser, or of the page of a session, whose events are reported before it."""
        self._number += 1
        message: dict[str, object] = {"id": self._number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._inlet, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self._number:
            if on_event is not None and answer.get("sessionId") == session:
                on_event(answer.get("method", ""), answer.get("params", {}))
        assert "error" not in answer, (method, answer["error"])
        return answer["result"]

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            assert select.select([self._outlet], [], [], PATIENCE_SECONDS)[0], "the browser does not answer"
            piece = os.read(self._outlet, 1 << 20)
            assert piece, "the browser is gone"
            self._buffer += piece
        message, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(message)


class Tab:
    """One page, and what went wrong in it."""

    def __init__(self, browser: Browser, session: str) -> None:
        self._browser, self._session = browser, session
        self.complaints: list[str] = []
        self.requests: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._call(f"{domain}.enable")

    def open(self, address: str, *, width: int = 320, height: int = 240) -> None:
        """Goes to ``address`` in a window of so many pixels."""
        self._call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        failed = self._call("Page.navigate", url=address).get("errorText")
        assert not failed, failed

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression, a promise's when it is kept."""
        found = self._call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait_for(self, expression: str) -> Any:
        """What the expression gives once that is truthy; the page may be left for another one meanwhile."""
        last = time.monotonic() + PATIENCE_SECONDS
        while time.monotonic() < last:
            try:
                if value := self.evaluate(expression):
                    return value
            except AssertionError as error:
                if "navigated" not in str(error):
                    raise
            time.sleep(0.1)
        raise AssertionError(f"{expression} never came true; the page says {self.complaints}")

    def drag(self, *points: tuple[int, int]) -> None:
        """Presses the mouse's button at the first pixel, goes by the others, and lets it go at the last."""
        kinds = ["mousePressed", *["mouseMoved"] * (len(points) - 1), "mouseReleased"]
        for kind, (x, y) in zip(kinds, (*points, points[-1]), strict=True):
            self._call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def screenshot(self) -> NDArray[np.uint8]:
        """What the window shows, ``[H, W, 3]`` sRGB."""
        return decoded_picture(base64.b64decode(self._call("Page.captureScreenshot", format="png")["data"]))

    def _call(self, method: str, **parameters: object) -> dict[str, Any]:
        return self._browser.call(method, session=self._session, on_event=self._note, **parameters)

    def _note(self, event: str, values: Mapping[str, Any]) -> None:
        if event == "Network.requestWillBeSent":
            self.requests.append(values["request"]["url"])
        elif event == "Runtime.exceptionThrown":
            self.complaints.append(str(values["exceptionDetails"]))
        elif event == "Runtime.consoleAPICalled" and values["type"] in ("error", "warning"):
            self.complaints.append(str(values["args"]))
        elif event == "Log.entryAdded" and values["entry"]["level"] == "error":
            self.complaints.append(str(values["entry"]))


def browser_program() -> str:
    """The browser's program; skips the test, or fails it when ``STRUCTGSTREAM_REQUIRE_BROWSER`` is set."""
    found = subprocess.run([ROOT / "scripts" / "find-browser"], capture_output=True, text=True, check=False)
    if found.returncode == 0:
        return found.stdout.strip()
    assert not os.environ.get("STRUCTGSTREAM_REQUIRE_BROWSER"), "there is no Chromium"
    pytest.skip("there is no Chromium on this machine; CHROMIUM can name one")


@contextmanager
def opened_browser(folder: Path) -> Iterator[Browser]:
    """A browser whose profile is in ``folder``."""
    program = browser_program()
    theirs_in, inlet = map(_moved, os.pipe())
    outlet, theirs_out = map(_moved, os.pipe())
    with (folder / "chromium.log").open("wb") as log:
        actions = [
            (os.POSIX_SPAWN_DUP2, log.fileno(), 1),
            (os.POSIX_SPAWN_DUP2, log.fileno(), 2),
            (os.POSIX_SPAWN_DUP2, theirs_in, 3),
            (os.POSIX_SPAWN_DUP2, theirs_out, 4),
        ]
        command = [program, *FLAGS, f"--user-data-dir={folder / 'profile'}"]
        process = os.posix_spawn(program, command, os.environ, file_actions=actions, setsid=True)
    os.close(theirs_in)
    os.close(theirs_out)
    try:
        yield Browser(inlet, outlet)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process, signal.SIGKILL)
        os.waitpid(process, 0)
        os.close(inlet)
        os.close(outlet)


def _moved(end: int) -> int:
    """The end of a pipe under a number that is none of those which the browser's ends get."""
    other = fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10)
    os.close(end)
    return other
