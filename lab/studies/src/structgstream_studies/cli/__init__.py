# SPDX-License-Identifier: Apache-2.0
"""Commands that ``structgstream`` finds by the entry point ``structgstream.commands``."""

COMMANDS = {
    "ablate": "run the paper's ablations on a capture, ours beside the paper's figures",
    "compare": "run several methods on a capture and score their files",
    "dataset": "run a preset on every capture of a data set of the paper, ours beside the paper's rows",
}
