# SPDX-License-Identifier: Apache-2.0
"""One heap for all threads of a server."""

import platform
import subprocess
import sys

import pytest

HEAPS = """
import ctypes, sys, threading
from structgstream.server.arenas import use_one_arena
if sys.argv[1] == "one":
    assert use_one_arena()
together = threading.Barrier(8)
def allocate():
    together.wait()
    kept = [bytes(8000 + i) for i in range(2000)]
    together.wait()
threads = [threading.Thread(target=allocate) for _ in range(8)]
for thread in threads: thread.start()
for thread in threads: thread.join()
libc = ctypes.CDLL(None)
libc.fdopen.restype = ctypes.c_void_p
out = ctypes.c_void_p(libc.fdopen(1, b"w"))
libc.malloc_info(0, out)
libc.fflush(out)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="arenas are glibc's")
@pytest.mark.parametrize(("arenas", "one"), [("one", True), ("as usual", False)])
def test_threads_share_a_heap(arenas: str, one: bool) -> None:
    told = subprocess.run([sys.executable, "-c", HEAPS, arenas], capture_output=True, text=True, check=True).stdout
    heaps = told.count("<heap nr=")
    assert (heaps == 1) if one else (heaps > 1), told
