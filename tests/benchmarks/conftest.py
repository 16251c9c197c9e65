# SPDX-License-Identifier: Apache-2.0
"""The package ``benchmarks`` lies beside ``src`` and is not installed."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))
