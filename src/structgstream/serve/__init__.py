# SPDX-License-Identifier: Apache-2.0
"""Streams in browsers: the web application of ``serve``, that of ``play``, the player's module and its pages."""
