# SPDX-License-Identifier: Apache-2.0
"""Other methods with the same frame loop and evaluator (docs/peers.md)."""
