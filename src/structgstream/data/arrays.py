# SPDX-License-Identifier: Apache-2.0
"""What arrays hold, in type hints."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
