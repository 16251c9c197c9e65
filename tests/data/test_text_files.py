# SPDX-License-Identifier: Apache-2.0
import json
from pathlib import Path

import pytest

from structgstream.data.text_files import (
    NamedFiles,
    Unreadable,
    number,
    path_parts,
    pixels,
    read_json,
    read_text,
    read_toml,
    whole,
)

TEXT = "fx: 1\nname: Köln\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_one_text_in_every_encoding(tmp_path: Path, encoding: str, end: str) -> None:
    file = tmp_path / "rig.txt"
    file.write_bytes(TEXT.replace("\n", end).encode(encoding))
    assert read_text(file) == TEXT


@pytest.mark.parametrize(("mark", "place"), [(b"", 1), (b"\xef\xbb\xbf", 4)])
def test_what_is_no_text(tmp_path: Path, mark: bytes, place: int) -> None:
    file = tmp_path / "rig.txt"
    file.write_bytes(mark + "Köln".encode("latin-1"))
    with pytest.raises(Unreadable, match=f"no Unicode text from byte {place} on; save it as UTF-8"):
        read_text(file)


def test_where_json_and_toml_break(tmp_path: Path) -> None:
    file = tmp_path / "rig"
    file.write_bytes(b"\xef\xbb\xbf" + json.dumps({"a": 1}).encode())
    assert read_json(file) == {"a": 1}
    for text, reported in (
        ('{"a": 1,\n}', "it is not JSON from line 2, column 1 on"),
        ("[" * 100_000, "it is not JSON"),
    ):
        file.write_text(text)
        with pytest.raises(Unreadable, match=reported):
            read_json(file)
    file.write_text("a = 1\n")
    assert read_toml(file) == {"a": 1}
    file.write_text("a = 1\nb = \n")
    with pytest.raises(Unreadable, match="it is not TOML at line 2, column 5"):
        read_toml(file)


def test_numbers() -> None:
    assert [number(value) for value in (1, "0,5", " -2.5e1 ")] == [1.0, 0.5, -25.0]
    assert (whole("320.0"), pixels(["640", 480.0])) == (320, (640, 480))
    for value, reported in (
        (None, "nothing in place of a number"),
        ("x", "'x' in place"),
        (10**400, r"10000.*\.\.\. in"),
    ):
        with pytest.raises(Unreadable, match=reported):
            number(value)
    with pytest.raises(Unreadable, match=r"not finite \(nan\)"):
        number("nan")
    with pytest.raises(Unreadable, match=r"1\.5 in place of a whole number"):
        whole(1.5)
    for size, reported in (
        (7, "7 in place of width and height"),
        ([0, 4], "of 0x4 pixels"),
        ([70_000, 4], "of 70000x4"),
    ):
        with pytest.raises(Unreadable, match=reported):
            pixels(size)


@pytest.mark.parametrize(
    "text",
    [
        "/data/images/cam0/1.png",
        "C:\\data\\images\\cam0\\1.png",
        "c:/data/images/cam0/1.png",
        "file:///data/images/cam0/1.png",
    ],
)
def test_parts_of_paths_of_every_system(text: str) -> None:
    assert path_parts(text) == ("data", "images", "cam0", "1.png")


def test_files_by_paths_of_other_machines(tmp_path: Path) -> None:
    for name in ("images/cam0/1.jpg", "images/cam1/1.jpg"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).touch()
    own = tmp_path / "images/cam0/1.jpg"
    for text in (
        "images/cam0/1.jpg", "./images/cam0/1.jpg", "images\\cam0\\1.jpg", "images/cam0/1", "images/cam0/1.png",
        str(own), "D:\\take\\images\\cam0\\1.JPG", "/home/other/take/images/cam0/1.jpg",
    ):  # fmt: skip
        assert NamedFiles(tmp_path, {".jpg", ".png"}).find(text) == own, text
    files = NamedFiles(tmp_path, {".jpg", ".png"})
    assert files.find("take/cam0/1.jpg") is None  # a relative path is no part of another
    assert files.find("images/cam0/2.jpg") is None
    assert files.find("images/cam1/1") == tmp_path / "images/cam1/1.jpg"
    with pytest.raises(Unreadable, match="both mean 1.jpg"):
        files.find("images/cam1/1.png")
