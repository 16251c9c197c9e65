# SPDX-License-Identifier: Apache-2.0
import inspect

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
    assert "pip install 'structgstream[capture]'" in str(errors.MissingExtraError("cv2", "capture"))
