# SPDX-License-Identifier: Apache-2.0
"""Serves streams to browsers: the web applications of ``serve`` and ``play``, the player's module and its pages."""
