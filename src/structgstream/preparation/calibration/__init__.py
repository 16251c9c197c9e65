# SPDX-License-Identifier: Apache-2.0
"""Poses, intrinsics and lenses of still cameras, from their own pictures."""
