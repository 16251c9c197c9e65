# SPDX-License-Identifier: Apache-2.0
"""Tries an installed structgstream: run by the Python of an empty environment, away from the repository.

Usage: python -I tools/wheel/smoke.py STREAM EXPECTED, a golden stream and what a decoder must find in it.
"""

import json
import struct
import subprocess
import sys
import sysconfig
import tempfile
import zlib
from pathlib import Path

import structgstream
from structgstream.scene.state import state_of

PROGRAM = Path(sys.executable).with_name("structgstream")


def run(*arguments: str | Path) -> None:
    """A command of structgstream that must end well."""
    subprocess.run([PROGRAM, *arguments], check=True, stdout=subprocess.DEVNULL, timeout=300)


def check_place() -> None:
    """The package is the installed one, and type checkers are told of its types."""
    package = Path(structgstream.__file__).parent
    assert package.parent == Path(sysconfig.get_path("purelib")), f"{package} is not what was installed"
    assert (package / "py.typed").is_file()


def check_doctor(folder: Path) -> None:
    """The native library loads."""
    run("doctor", "--json", folder / "doctor.json")
    backends = {entry["name"]: entry for entry in json.loads((folder / "doctor.json").read_text())["backends"]}
    assert backends["cpu"]["available"], backends["cpu"]["advice"]


def check_decoder(stream: Path, expected: Path) -> int:
    """Every number of every frame is the golden one; the number of frames."""
    frames = json.loads(expected.read_text())["frames"]
    scenes = [scene for _, scene in structgstream.open_stream(stream).scenes()]
    assert len(scenes) == len(frames)
    for scene, frame in zip(scenes, frames, strict=True):
        got = {name: {"shape": list(v.shape), "values": v.flatten().tolist()} for name, v in state_of(scene).items()}
        assert got == frame["fields"], f"frame {frame['index']} is not the golden one"
    return len(frames)


def check_picture(stream: Path, folder: Path) -> None:
    """The CPU back-end draws something."""
    picture = folder / "picture.png"
    run("render", stream, "--frame", "0", "--device", "cpu", "-o", picture)
    data, parts, place = picture.read_bytes(), [], 8
    assert data.startswith(b"\x89PNG")
    while place < len(data):
        length, kind = struct.unpack_from(">I4s", data, place)
        if kind == b"IDAT":
            parts.append(data[place + 8 : place + 8 + length])
        place += length + 12
    assert len(set(zlib.decompress(b"".join(parts)))) > 8, "the picture is empty"


def check_page(stream: Path, folder: Path) -> None:
    """The page holds the player and the stream."""
    run("export", stream, "-o", folder / "page.html")
    page = (folder / "page.html").read_text()
    player = Path(structgstream.__file__).parent / "serve" / "assets" / "player.js"
    assert "<structgstream-player" in page
    assert len(page) > player.stat().st_size + stream.stat().st_size


def main(stream: Path, expected: Path) -> None:
    """Runs every check."""
    check_place()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        check_doctor(folder)
        frames = check_decoder(stream, expected)
        check_picture(stream, folder)
        check_page(stream, folder)
    version = ".".join(map(str, sys.version_info[:3]))
    print(f"structgstream {structgstream.__version__} on Python {version}: doctor, {frames} frames, picture, page")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
