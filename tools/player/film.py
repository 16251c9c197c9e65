# SPDX-License-Identifier: Apache-2.0
"""Films the player for the README: the page of a stream, turned from side to side while it plays, as an animated WebP.

    structgstream export clip.sgs -o clip.html
    PYTHONPATH=. python tools/player/film.py clip.html docs/images/player.webp

Each picture is a screenshot of a real browser, taken when the player says that what it shows is settled; so the film's
pace is not that of the machine that made it.
"""

import argparse
import math
import tempfile
from pathlib import Path

from PIL import Image

from tests.support.chromium import Tab, opened_browser

PLAYER = 'document.querySelector("structgstream-player")'


def filmed(tab: Tab, size: tuple[int, int], *, frames: int, pictures: int, sway: int, fps: float) -> list[Image.Image]:
    """``pictures`` screenshots in which the stream's ``frames`` pass twice and a hand turns the scene once to and fro.

    Args:
        tab: with the page.
        size: of the window, pixels.
        frames: of the stream.
        pictures: to take.
        sway: how far the hand goes to either side, pixels.
        fps: of the stream.
    """
    tab.wait_for(f"{PLAYER}?.stats?.settled")
    tab.evaluate(f"{PLAYER}.pause(), {PLAYER}.setAttribute('theme', 'dark'), 1")
    middle = (size[0] // 2, size[1] // 3)
    found, at = [], 0
    for i in range(pictures):
        frame = 2 * frames * i // pictures % frames
        to = round(sway * math.sin(2 * math.pi * i / pictures))
        tab.evaluate(f"{PLAYER}.seek({(frame + 0.5) / fps}), 1")
        tab.wait_for(f"{PLAYER}.stats.frameIndex === {frame}")
        # By way of another place: a hand that does not go far enough has clicked, which plays.
        tab.drag(middle, (middle[0] + 30, middle[1]), (middle[0] + to - at, middle[1]))
        at = to
        tab.evaluate("new Promise(requestAnimationFrame)")
        tab.wait_for(f"{PLAYER}.stats.settled")
        found.append(Image.fromarray(tab.screenshot()))
    return found


def main() -> None:
    """Films the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 400), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--pictures", type=int, default=48)
    parser.add_argument("--sway", type=int, default=60, help="how far the hand goes to either side, pixels")
    parser.add_argument("--frames", type=int, default=12, help="of the stream")
    parser.add_argument("--fps", type=float, default=30.0, help="of the stream")
    parser.add_argument("--quality", type=int, default=60)
    options = parser.parse_args()
    width, height = options.size
    with (
        tempfile.TemporaryDirectory() as folder,
        opened_browser(Path(folder)) as browser,
        browser.opened_tab() as tab,
    ):
        tab.open(options.page.resolve().as_uri(), width=width, height=height)
        pictures = filmed(
            tab,
            (width, height),
            frames=options.frames,
            pictures=options.pictures,
            sway=options.sway,
            fps=options.fps,
        )
        complaints = tab.complaints
    first, *others = pictures
    first.save(
        options.output, save_all=True, append_images=others, duration=83, loop=0, quality=options.quality, method=6
    )
    print(
        f"{options.output}: {options.output.stat().st_size:,} bytes, {len(pictures)} pictures; page says {complaints}"
    )


if __name__ == "__main__":
    main()
