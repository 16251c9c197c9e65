# SPDX-License-Identifier: Apache-2.0
"""The player in a notebook: ``structgstream.notebook.Player("ball.sgs")`` as the last line of a cell.

Needs the extra ``notebook``. The stream is part of the widget's state, so a notebook saved with that state plays
without Python.
"""

from pathlib import Path

from structgstream.errors import MissingExtraError
from structgstream.serve.pages import StreamFile, bundle, check_has_header

try:
    import anywidget
    import traitlets
except ModuleNotFoundError as error:
    raise MissingExtraError(error.name or "anywidget", "notebook") from None

# Appended to the bundle, which defines the element: creates and removes it. A player opens streams only while it is in
# the document, and a notebook may insert the rendered element later.
_WIDGET = """
export default {
  render({ model, el }) {
    const player = document.createElement("structgstream-player");
    player.toggleAttribute("isolated", true);
    player.toggleAttribute("loop", true);
    let waiting;
    const load = () => {
      cancelAnimationFrame(waiting);
      if (player.isConnected) player.load(new Blob([model.get("stream")]));
      else waiting = requestAnimationFrame(load);
    };
    const resize = () => {
      player.style.cssText = `width: 100%; height: ${model.get("height_pixels")}px`;
    };
    resize();
    load();
    model.on("change:stream", load);
    model.on("change:height_pixels", resize);
    el.append(player);
    return () => {
      cancelAnimationFrame(waiting);
      model.off("change:stream", load);
      model.off("change:height_pixels", resize);
      player.remove();
    };
  },
};
"""


class Player(anywidget.AnyWidget):
    """A player as the output of a notebook's cell.

    Args:
        stream: a stream file, read at its present length, or a stream's bytes.
        height_pixels: height of the player; its width is that of the cell.

    Attributes:
        stream: the bytes of the shown stream; assigning others replaces it.

    Raises:
        StreamError: no frame of the stream can be decoded.
        PlayerError: the installation lacks the player.
    """

    _esm = traitlets.Unicode().tag(sync=True)
    stream = traitlets.Bytes().tag(sync=True)
    height_pixels = traitlets.Int(480).tag(sync=True)

    def __init__(self, stream: Path | str | bytes, *, height_pixels: int = 480) -> None:
        super().__init__(_esm=bundle() + _WIDGET, stream=_stream_bytes(stream), height_pixels=height_pixels)


def _stream_bytes(stream: Path | str | bytes) -> bytes:
    if isinstance(stream, bytes):
        check_has_header(stream, "The stream")
        return stream
    with StreamFile(Path(stream)).opened() as data:
        check_has_header(data, str(stream))
        return data[:]
