# SPDX-License-Identifier: Apache-2.0
import inspect
from pathlib import Path

import pytest

from structgstream import errors


def test_the_drawn_tree_is_the_tree() -> None:
    """The picture at the top of the module names every error, indented under its parent."""
    assert errors.__doc__ is not None
    for name, kind in inspect.getmembers(errors, inspect.isclass):
        assert issubclass(kind, errors.StructGStreamError)
        assert name in errors.__doc__, name
    assert issubclass(errors.CalibrationError, errors.CaptureError)


def test_exhausted_memory_is_a_memory_error_too() -> None:
    assert issubclass(errors.OutOfMemoryError, MemoryError)
    assert str(errors.OutOfMemoryError("to lift flow")).startswith("Not enough memory to lift flow; ")


def test_a_missing_extra_names_the_command_that_brings_it() -> None:
    with pytest.raises(errors.MissingExtraError, match=r"is not installed; .* pip install 'structgstream\[capture\]'"):
        errors.import_extra("structgstream_missing.part", "capture")


def test_an_extra_that_cannot_be_imported_is_not_called_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "structgstream_broken.py").write_text("raise ImportError('libX11.so.6: cannot open')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(errors.MissingExtraError, match=r"cannot be imported \(libX11\.so\.6: cannot open\)"):
        errors.import_extra("structgstream_broken", "capture")
