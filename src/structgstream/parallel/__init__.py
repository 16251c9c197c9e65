# SPDX-License-Identifier: Apache-2.0
"""A stream whose groups of frames are fitted side by side, by whatever executor there is, and what that costs."""
