# SPDX-License-Identifier: Apache-2.0
"""Other methods behind the same loop and the same evaluator (docs/peers.md)."""
