# SPDX-License-Identifier: Apache-2.0
"""The arrays of whole numbers that the codec passes on."""

import numpy as np
from numpy.typing import NDArray

Bins = NDArray[np.int32]
Naturals = NDArray[np.int64]
Flags = NDArray[np.bool_]
Contexts = NDArray[np.uint16]
