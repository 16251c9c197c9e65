# SPDX-License-Identifier: Apache-2.0
"""Reads an ``.npy`` file of objects without letting it run anything.

Note [Pickles are programs]

A pickle names functions and calls them, so that opening one from elsewhere can do whatever its author likes.
Dictionaries, lists, text and numbers need no function; arrays need those below, which are replaced by ones that make
an empty array, a type of numbers, or text, and nothing else. Any other name ends the reading.
"""

import pickle
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.text_files import Unreadable
from structgstream.errors import CalibrationError


class _Refused(pickle.UnpicklingError):
    """It asks for what is not known."""


class _Arrays(pickle.Unpickler):
    """See Note [Pickles are programs]."""

    def find_class(self, module: str, name: str, /) -> Any:
        """The stand-in for a function of numpy.

        Raises:
            UnpicklingError: another one is asked for.
        """
        if (known := KNOWN.get((module.replace("numpy._core", "numpy.core"), name))) is None:
            raise _Refused(f"it asks for {module}.{name}")
        return known


class _Type:
    """Stands for ``numpy.ndarray`` and cannot be called."""


def _empty_array(kind: Any, shape: Any, code: Any) -> np.ndarray:
    del kind, shape, code  # __setstate__ follows with the content
    return np.empty(0)


def _number(kind: np.dtype, data: bytes) -> Any:
    if kind.hasobject:
        raise _Refused("it has a number that is an object")
    return np.frombuffer(data, kind, count=1)[0]


def _text(text: str, coding: str) -> bytes:
    if coding != "latin1":
        raise _Refused(f"it has text of the coding {coding}")
    return text.encode(coding)


KNOWN = {
    ("numpy.core.multiarray", "_reconstruct"): _empty_array,
    ("numpy.core.multiarray", "scalar"): _number,
    ("numpy", "ndarray"): _Type,
    ("numpy", "dtype"): np.dtype,
    ("_codecs", "encode"): _text,
}


def load_plain(file: Path) -> Any:
    """The object of an ``.npy`` file of dictionaries, lists, text, numbers and arrays of them.

    Raises:
        CalibrationError: it holds anything else.
        Unreadable: it is not such a file, or is cut.
        OSError: it cannot be read.
    """
    with file.open("rb") as stream:
        try:
            version = np.lib.format.read_magic(stream)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            if not header(stream)[2].hasobject:
                raise Unreadable("it is an array of numbers")
            return _Arrays(stream, encoding="latin1").load()
        except _Refused as error:
            raise CalibrationError(
                f"{file} is a pickle that holds more than arrays ({error}), and opening it could run any program; "
                "it is refused. Convert it, with a program that you trust, to one of the formats of docs/captures.md."
            ) from None
        except Unreadable:
            raise
        except Exception:  # a cut or forged one can raise anything
            raise Unreadable("it is cut or damaged") from None
