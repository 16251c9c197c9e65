# SPDX-License-Identifier: Apache-2.0
"""The command line: ``structgstream COMMAND``. Importing it is free; a command imports what it needs when it
runs.
"""

from structgstream.cli.app import main

__all__ = ["main"]
