# SPDX-License-Identifier: Apache-2.0
"""A stream as immutable files and a manifest in a folder or an object store (docs/segments.md)."""
