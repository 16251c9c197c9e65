# SPDX-License-Identifier: Apache-2.0
"""Clocks of cameras that run freely, from tables, time stamps, sound or motion."""
