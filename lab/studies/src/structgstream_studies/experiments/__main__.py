# SPDX-License-Identifier: Apache-2.0
"""Renews the tables of documents: ``python -m structgstream_studies.experiments RESULTS DOCUMENT [DOCUMENT ...]``."""

import sys
from pathlib import Path

from structgstream.errors import StructGStreamError
from structgstream_studies.experiments.documents import refresh


def main(arguments: list[str]) -> int:
    """Renews the tables and prints which documents changed."""
    if len(arguments) < 2:
        print(__doc__, file=sys.stderr)
        return 2
    try:
        for path in refresh([Path(name) for name in arguments[1:]], Path(arguments[0])):
            print(f"renewed {path}")
    except (StructGStreamError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
