# SPDX-License-Identifier: Apache-2.0
"""Executes a command that is killed when its parent process ends for any reason.

Run as a program, without this package: ``python -I -S launch.py PARENT COMMAND...``. The kernel's parent-death signal
survives ``exec``, so no process remains between parent and command. It is set here, not between fork and exec of the
parent, where threads of the parent may hold locks. It exists only on Linux.
"""

import os
import signal
import sys

PR_SET_PDEATHSIG = 1


def main() -> None:
    """Sets the parent-death signal and executes the command."""
    parent, command = int(sys.argv[1]), sys.argv[2:]
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:  # The parent has ended already.
            return
    try:
        os.execvp(command[0], command)
    except OSError as error:
        sys.exit(f"{command[0]} cannot be run ({error.strerror}).")


if __name__ == "__main__":
    main()
