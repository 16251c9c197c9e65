# SPDX-License-Identifier: Apache-2.0
"""The player for browsers: its bundle, the pages that hold it, and the server of ``structgstream play``."""
