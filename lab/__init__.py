# SPDX-License-Identifier: Apache-2.0
"""The laboratory: studies and measurements that no user needs."""
