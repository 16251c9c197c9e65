# SPDX-License-Identifier: Apache-2.0
"""``python -m structgstream`` is ``structgstream``."""

import sys

from structgstream.cli import program

sys.exit(program())
