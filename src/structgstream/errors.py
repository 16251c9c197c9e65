# SPDX-License-Identifier: Apache-2.0
"""The package's exceptions.

::

    StructGStreamError
    |-- CaptureError            a capture cannot be read, or contradicts itself
    |   `-- CalibrationError    a camera's calibration is missing, invalid or of another convention
    |-- StreamError             a file is not a stream, is damaged, or of another major version
    |-- StorageError            the stream cannot be written (disk full, no permission)
    |-- BackendError            a compute back-end is not available on this machine
    |-- ConfigError             an option has an invalid value
    |-- OutOfMemoryError        a kernel has not enough memory; also a MemoryError
    |-- TaskError               tasks of a run failed; results of the others are retained
    |-- PlayerError             the player cannot be served, or does not fit in a page
    `-- MissingExtraError       an optional dependency is not installed

Each message states in one or two sentences what was found, what was expected, and what to do. The command line prints
it without a traceback and exits with status 1.
"""

import importlib
import typing


class StructGStreamError(Exception):
    """Base class of the package's exceptions."""


class CaptureError(StructGStreamError):
    """A capture cannot be read, or contradicts itself."""


class CalibrationError(CaptureError):
    """A camera's calibration is missing, invalid, or of another convention."""


class StreamError(StructGStreamError):
    """A file is not a stream of this format, is damaged, or has another major version."""


class StorageError(StructGStreamError):
    """The stream cannot be written; earlier packets stay readable."""


class BackendError(StructGStreamError):
    """A compute back-end is not available on this machine."""


class ConfigError(StructGStreamError):
    """A configuration value is invalid."""


class OutOfMemoryError(StructGStreamError, MemoryError):
    """There is not enough memory; the message states for what."""

    def __init__(self, work: str, *, on_gpu: bool = False) -> None:
        advice = "close other programs, or use smaller pictures (--scale 0.5)"
        advice += " or the processor (--device cpu)" if on_gpu else ""
        super().__init__(f"Not enough memory {work}; {advice}.")


class TaskError(StructGStreamError):
    """Tasks of a run failed. The message names them and the first one's reason. Results of the others are retained."""


class PlayerError(StructGStreamError):
    """The player cannot be served here, or a stream does not fit in a page."""


class MissingExtraError(StructGStreamError):
    """An optional dependency is missing or ``broken``; the message names the extra that installs it."""

    def __init__(self, module: str, extra: str, *, broken: str | None = None) -> None:
        state = "is not installed; install it" if broken is None else f"cannot be imported ({broken}); install it again"
        super().__init__(f"The module {module!r} is needed here and {state} with: pip install 'structgstream[{extra}]'")


def import_extra(module: str, extra: str) -> typing.Any:
    """An optional module. Raises MissingExtraError, which names the ``extra`` that installs it, if it is missing or
    cannot be imported."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        broken = None if isinstance(error, ModuleNotFoundError) else str(error)
        raise MissingExtraError(module.partition(".")[0], extra, broken=broken) from error
