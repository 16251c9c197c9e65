# SPDX-License-Identifier: Apache-2.0
"""The server of ``structgstream serve``: live and finished streams of a folder, for many viewers."""
