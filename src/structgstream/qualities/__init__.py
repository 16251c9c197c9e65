# SPDX-License-Identifier: Apache-2.0
"""Several qualities of one stream, fitted to the same frames by one process."""
