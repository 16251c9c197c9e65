# SPDX-License-Identifier: Apache-2.0
"""From videos of still cameras to a calibrated capture."""
