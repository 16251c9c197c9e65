# SPDX-License-Identifier: Apache-2.0
"""Files in which other tools state cameras, converted to :class:`~structgstream.data.calibration.Calibration`."""
