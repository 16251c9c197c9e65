# SPDX-License-Identifier: Apache-2.0
"""Types of the codec's integer arrays."""

import numpy as np
from numpy.typing import NDArray

Bins = NDArray[np.int32]
Naturals = NDArray[np.int64]
Flags = NDArray[np.bool_]
Contexts = NDArray[np.uint16]
