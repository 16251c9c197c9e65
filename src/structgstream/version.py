# SPDX-License-Identifier: Apache-2.0
"""The version of the package. The version of the stream format is in ``codec/container/records.py``."""

__version__ = "0.1.0"
