# SPDX-License-Identifier: Apache-2.0
"""Contestants on the same work in one process: results are checked before they are timed, runs are interleaved."""
