# SPDX-License-Identifier: Apache-2.0
"""The C library's memory for a process that keeps and drops files for days.

Note [One arena]
~~~~~~~~~~~~~~~~
Threads read files and the loop drops them. glibc gives threads heaps of their own ("arenas"), and what is free in one
cannot be used by another nor given back to the system while anything behind it is kept. So the server grew although
its cache did not: 108 MB after 8,500 frames, 142 MB after 46,000 (docs/serve.md). With one arena it stays.
"""

import ctypes
from typing import Final

_M_ARENA_MAX: Final = -8  # glibc's malloc.h


def use_one_arena() -> bool:
    """Makes all threads that begin from now on share one heap; whether the C library can (Note [One arena]).

    It acts on the whole process, so it is for programs, not for libraries.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, TypeError, AttributeError):  # Another C library than glibc, or another system.
        return False
    return bool(mallopt(_M_ARENA_MAX, 1))
