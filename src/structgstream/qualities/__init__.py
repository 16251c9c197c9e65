# SPDX-License-Identifier: Apache-2.0
"""Several qualities of one stream, made of the same frames by one process."""
