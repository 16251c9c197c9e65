# SPDX-License-Identifier: Apache-2.0
"""The machine is described with plain values."""

import json

from structgstream.evaluation.environment import environment


def test_environment_is_plain_and_filled() -> None:
    facts = json.loads(json.dumps(environment()))
    assert facts["cores"] >= 1
    assert facts["cpu"]
    assert facts["python"].startswith("3.")
    assert facts["torch"]
