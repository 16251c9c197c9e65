# SPDX-License-Identifier: Apache-2.0
"""Common parts of the package's plots: figures, axes, colours, saving."""

import warnings
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from structgstream.atomic_files import atomic_write
from structgstream.errors import import_extra

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The colours of Okabe and Ito, distinguishable with all common kinds of colour vision.
COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#F0E442", "#222222")
INK, FAINT, OTHER = "#222222", "#dddddd", "#999999"


def figure_of(
    width: float, height: float, *, dpi: int = 110, layout: Literal["constrained"] | None = "constrained"
) -> "Figure":
    """An empty figure, in inches. Raises MissingExtraError if matplotlib is not installed."""
    import_extra("matplotlib.figure", "report")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, facecolor="white", layout=layout)
    FigureCanvasAgg(figure)
    return figure


def without_frame(axis: "Axes") -> None:
    """Removes the frame of an axes, except for the lines needed to read values."""
    axis.grid(axis="y", color=FAINT, linewidth=0.8)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=8)


def save_figure(figure: "Figure", path: Path) -> None:
    """Writes a picture atomically, and creates its folder if necessary. Raises StorageError if the file cannot be
    written."""
    content = BytesIO()
    with warnings.catch_warnings():
        # The font may lack letters of camera names and then draws boxes.
        warnings.filterwarnings("ignore", message=r"Glyph \d+ .* missing from")
        figure.savefig(content, format=path.suffix.removeprefix(".") or "png")
    atomic_write(path, content.getvalue(), called="The picture", new_folder=True, sync=False)
