# SPDX-License-Identifier: Apache-2.0
"""Everything that the package raises on purpose.

::

    StructGStreamError
    |-- CaptureError            a capture cannot be read, or contradicts itself
    |   `-- CalibrationError    a camera's numbers are missing, broken or of another convention
    |-- StreamError             a stream file is not ours, damaged, or of a newer major version
    |-- StorageError            the stream cannot be written (disk full, no permission)
    |-- BackendError            a compute back-end is not available on this machine
    |-- ConfigError             an option has a value that cannot work
    |-- OutOfMemoryError        memory does not suffice for a kernel; a MemoryError too
    |-- PlayerError             the player cannot be served, or does not fit in a page
    `-- MissingExtraError       an optional dependency is not installed

Each message is one sentence or two that say what was got, what was expected, and what to do. The command line prints it
without a traceback and exits with status 1.
"""


class StructGStreamError(Exception):
    """The root of the package's errors: catching it catches everything raised on purpose."""


class CaptureError(StructGStreamError):
    """A capture cannot be read, or contradicts itself."""


class CalibrationError(CaptureError):
    """A camera's calibration is missing, broken, or of another convention."""


class StreamError(StructGStreamError):
    """A stream is not one of ours, is damaged, or has a newer major version."""


class StorageError(StructGStreamError):
    """The stream cannot be written; what was written before stays readable."""


class BackendError(StructGStreamError):
    """A compute back-end is not available on this machine."""


class ConfigError(StructGStreamError):
    """A configuration value cannot work."""


class OutOfMemoryError(StructGStreamError, MemoryError):
    """Memory does not suffice; the message says for what."""

    def __init__(self, work: str) -> None:
        super().__init__(f"Memory does not suffice {work}; end other programs, or take smaller pictures (--scale 0.5).")


class PlayerError(StructGStreamError):
    """The player cannot be served here, or a stream does not fit in a page."""


class MissingExtraError(StructGStreamError):
    """An optional dependency is missing; the message names the extra that brings it."""

    def __init__(self, module: str, extra: str) -> None:
        super().__init__(
            f"The module {module!r} is needed here and is not installed; "
            f"install it with: pip install 'structgstream[{extra}]'"
        )
