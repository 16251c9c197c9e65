# SPDX-License-Identifier: Apache-2.0
"""Files in which other tools state cameras, one converter each, to :class:`~structgstream.data.posed.Calibration`.

A converter is a module with ``find``, which says which files of a folder are its own, and ``read``.
"""
