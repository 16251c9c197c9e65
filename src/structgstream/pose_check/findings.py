# SPDX-License-Identifier: Apache-2.0
"""What a check of a capture finds."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")  # the worst first


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or worth knowing.

    Args:
        severity: a stream made with an ``error`` is spoiled; a ``warning`` costs quality; a ``note`` is worth
            knowing.
        sentence: names camera or file, what was found and what to do.
        cameras: those concerned.
    """

    severity: Severity
    sentence: str
    cameras: tuple[str, ...] = ()


def worst_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings in the order of their severity."""
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))
