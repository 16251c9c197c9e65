# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from structgstream.preparation import report


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Calls a function that draws, and returns its figure."""

    def draw(function: Callable[..., None], *arguments: Any, **keywords: Any) -> Any:
        kept: list[Any] = []
        monkeypatch.setattr(report, "save_figure", lambda figure, path: kept.append(figure))
        function(Path("unused.png"), *arguments, **keywords)
        (figure,) = kept
        return figure

    return draw
