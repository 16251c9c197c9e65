# SPDX-License-Identifier: Apache-2.0
"""Whether poses and names fit the pictures: one judgement for ``reconstruct``, ``prepare`` and ``prepare --check``."""
