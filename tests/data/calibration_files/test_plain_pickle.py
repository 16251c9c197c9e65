# SPDX-License-Identifier: Apache-2.0
import io
import os
import pickle
import pickletools
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from structgstream.data.calibration_files.reading import load_plain
from structgstream.errors import CalibrationError

PLAIN = {
    "cams": {"K": [np.eye(3), np.arange(4, dtype=np.float32)], "name": np.array(["a", "bc"]), "n": np.float64(2.5)},
    "ims": [{"ims": ["cam/0.jpg"], "mixed": np.array([1, "x", None], dtype=object)}, (1, 2.0, True, b"raw")],
}


def save(path: Path, value: Any, *, protocol: int = 4) -> Path:
    """As ``np.save`` does, with another protocol of pickle."""
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "|O", "fortran_order": False, "shape": ()})
    path.write_bytes(buffer.getvalue() + pickle.dumps(np.array(value, dtype=object), protocol))
    return path


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL))
def test_plain_things_come_back(tmp_path: Path, protocol: int) -> None:
    found = load_plain(save(tmp_path / "a.npy", PLAIN, protocol=protocol)).item()
    np.testing.assert_equal(found, PLAIN)


def test_what_numpy_saves_comes_back(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array(PLAIN, dtype=object))
    np.testing.assert_equal(load_plain(tmp_path / "a.npy").item(), PLAIN)


class Calls:
    """Unpickles as the call of a function."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (Calls(os.system, "touch ran"), "system"),
        (Calls(eval, "1 + 1"), "eval"),
        (Calls(np.load, "other.npy"), "load"),
        (Calls(np.fromfile, "other.npy"), "fromfile"),
        (Calls(getattr, "a", "upper"), "getattr"),
        (Calls(Path, "a"), "pathlib"),
        (Calls(bytearray, 10), "bytearray"),
    ],
)
def test_programs_are_refused_before_they_run(tmp_path: Path, monkeypatch: Any, call: Calls, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    for value in (call, {"cams": [1, call]}, np.array([call], dtype=object)):
        file = save(tmp_path / "a.npy", value)
        with pytest.raises(
            CalibrationError, match=rf"a\.npy is a pickle that holds more than arrays .*{name}.*refused"
        ):
            load_plain(file)
    assert not (tmp_path / "ran").exists()


def test_a_number_that_is_an_object_is_refused(tmp_path: Path) -> None:
    from numpy._core.multiarray import scalar  # type: ignore[attr-defined]

    file = save(tmp_path / "a.npy", [Calls(scalar, np.dtype("O"), b"cos\nsystem\n.")])
    with pytest.raises(CalibrationError, match="holds more than arrays"):
        load_plain(file)


def test_what_is_cut_or_something_else(tmp_path: Path) -> None:
    whole = save(tmp_path / "a.npy", PLAIN).read_bytes()
    for end in (0, 5, 60, 140, len(whole) - 1):
        (tmp_path / "cut.npy").write_bytes(whole[:end])
        with pytest.raises((ValueError, CalibrationError)):
            load_plain(tmp_path / "cut.npy")
    np.save(tmp_path / "numbers.npy", np.eye(3))
    with pytest.raises(ValueError, match="array of numbers"):
        load_plain(tmp_path / "numbers.npy")


def test_forged_bytes_raise_one_of_two_errors(tmp_path: Path) -> None:
    """Any byte of a file may be wrong: nothing else is raised, and nothing is called."""
    whole = save(tmp_path / "a.npy", {"cams": {"K": [np.eye(2)]}}, protocol=2).read_bytes()
    assert sum(1 for _ in pickletools.genops(whole[whole.index(b"\x80") :])) > 20
    generator = np.random.default_rng(0)
    for _ in range(300):
        data = bytearray(whole)
        for at in generator.integers(80, len(whole), 2):
            data[at] = generator.integers(256)
        (tmp_path / "forged.npy").write_bytes(data)
        with suppress(ValueError, CalibrationError):
            load_plain(tmp_path / "forged.npy")
