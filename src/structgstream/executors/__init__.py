# SPDX-License-Identifier: Apache-2.0
"""Runs commands that depend on each other: in this process, in processes of this machine, or on a Ray cluster."""
