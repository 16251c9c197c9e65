# SPDX-License-Identifier: Apache-2.0
"""The report of a check: a page with pictures, and all numbers."""
