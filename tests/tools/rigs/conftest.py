# SPDX-License-Identifier: Apache-2.0
"""The scripts of ``tools`` lie beside ``src`` and are not installed."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[3]))
