# SPDX-License-Identifier: Apache-2.0
"""Captures: readers of common layouts with one protocol, resizing, prefetching."""
