# SPDX-License-Identifier: Apache-2.0
"""Studies with structgstream: other methods behind the same loop, and the paper's variants run and set side by side."""
