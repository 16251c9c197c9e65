# SPDX-License-Identifier: Apache-2.0
"""The command line: ``structgstream COMMAND``. Commands import their modules when they run."""

from structgstream.cli.app import main, program

__all__ = ["main", "program"]
