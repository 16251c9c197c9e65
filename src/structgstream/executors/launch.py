# SPDX-License-Identifier: Apache-2.0
"""Becomes the command that follows it, which then ends when the process that began it ends, however that came.

Run as a program, without this package: ``python -I -S launch.py PARENT COMMAND...``. The kernel's note to kill a
process with its parent survives ``exec``, so nothing stands between the two; it is set here, and not between fork and
exec of the parent, where threads of the parent may hold locks. Other systems than Linux do not have it.
"""

import os
import signal
import sys

PR_SET_PDEATHSIG = 1


def main() -> None:
    """Ties itself to its parent, and executes the command."""
    parent, command = int(sys.argv[1]), sys.argv[2:]
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:  # It ended before.
            return
    try:
        os.execvp(command[0], command)
    except OSError as error:
        sys.exit(f"{command[0]} cannot be run ({error.strerror}).")


if __name__ == "__main__":
    main()
