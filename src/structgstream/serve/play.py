# SPDX-License-Identifier: Apache-2.0
"""The web application of ``structgstream play``: page, player, one stream, and pictures of the capture.

Note [Loopback only]
~~~~~~~~~~~~~~~~~~~~
The server listens on the loopback address, so any page open in a browser can reach it. Three measures protect it:
requests whose Host is not a name of this machine are refused, against DNS rebinding; no response allows another origin
to read it; and URLs name cameras and frames, never files.
"""

import threading
from collections.abc import Callable, Iterator
from functools import lru_cache

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from structgstream.data.images import opencv
from structgstream.data.source import FrameSource, select_cameras
from structgstream.errors import CaptureError, StreamError
from structgstream.frames import MultiViewFrame
from structgstream.serve.listening import LOOPBACK_NAMES
from structgstream.serve.pages import SERVED_POLICY, StreamFile, bundle, linked_page, policy
from structgstream.serve.responses import NO_STORE_HEADERS, file_response

JPEG_QUALITY = 95
MAX_CACHED_PIXELS = 64 * 1920 * 1080  # of JPEG pictures, some 64 MB
MAX_SKIPPED = 8  # decoding and skipping up to this many frames costs less than seeking in reopened videos


class Truth:
    """Pictures of a capture at the stream's size, one camera and frame at a time; ``cameras`` are in both capture and
    stream.

    They are decoded on demand and cached. Consecutive frames of one camera are decoded without seeking. Raises
    MissingExtraError without OpenCV, which encodes pictures.
    """

    def __init__(self, source: FrameSource, cameras: tuple[str, ...]) -> None:
        self.cameras = cameras
        self.frames = len(source)
        self._source = source
        self._cv2 = opencv()
        self._lock = threading.Lock()
        self._open: tuple[str, int, Iterator[MultiViewFrame]] | None = None
        largest = max((source.rig[name].width * source.rig[name].height for name in cameras), default=1)
        self._cached = lru_cache(max(1, MAX_CACHED_PIXELS // largest))(self._encoded)

    def jpeg(self, camera: str, frame: int) -> bytes | None:
        """A camera's picture as JPEG; None if there is no such camera or frame, or the camera is absent from it. Raises
        CaptureError if the picture cannot be read."""
        if camera not in self.cameras or not 0 <= frame < self.frames:
            return None
        with self._lock:
            return self._cached(camera, frame)

    def _encoded(self, camera: str, frame: int) -> bytes | None:
        image = self._at(camera, frame).images.get(camera)
        if image is None:
            return None
        cv2 = self._cv2
        # No chroma subsampling, because pixels are compared.
        sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, *sampling]
        whole, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
        assert whole, "an 8-bit picture can be encoded"
        return data.tobytes()

    def _at(self, camera: str, frame: int) -> MultiViewFrame:
        open_video, self._open = self._open, None  # A decoder is not used again after an error.
        if open_video is not None and open_video[0] == camera and 0 <= frame - open_video[1] <= MAX_SKIPPED:
            frames = open_video[2]
        else:
            frames = select_cameras(self._source, (camera,)).frames(frame)
        found = next(frames)
        while found.index < frame:
            found = next(frames)
        self._open = (camera, frame + 1, frames)
        return found


def application(stream: StreamFile, *, truth: Truth | None = None) -> Starlette:
    """The application; each request opens the file anew, so it may grow meanwhile. ``truth`` is the capture's pictures
    to compare with. Raises PlayerError if the installation lacks the player."""
    module = bundle()
    page = linked_page(stream.path.name, stream="stream", attributes={"truth": "truth.json"} if truth else {})
    # A growing file may differ in each response, so responses are not cached and have no validators.
    headers = NO_STORE_HEADERS
    page_headers = {**headers, "Content-Security-Policy": policy(**SERVED_POLICY, frame_ancestors="'self'")}

    def index(request: Request) -> Response:
        return HTMLResponse(page, headers=page_headers)

    def player(request: Request) -> Response:
        return Response(module, media_type="text/javascript", headers=headers)

    def state(request: Request) -> Response:
        return JSONResponse(stream.state(), headers=headers)

    def stream_bytes(request: Request) -> Response:
        return file_response(stream.opened(), request, headers)

    def cameras(request: Request) -> Response:
        return JSONResponse(list(truth.cameras) if truth else [], headers=headers)

    def picture(request: Request) -> Response:
        camera, frame = request.path_params["camera"], request.path_params["frame"]
        data = None if truth is None else truth.jpeg(camera, frame)
        if data is None:
            return PlainTextResponse("There is no such camera or frame.", 404, headers)
        return Response(data, media_type="image/jpeg", headers=headers)

    def refusing(status: int) -> Callable[[Request, Exception], Response]:
        return lambda request, error: PlainTextResponse(str(error), status, headers)

    return Starlette(
        routes=[
            Route("/", index),
            Route("/player.js", player),
            Route("/state", state),
            Route("/stream", stream_bytes),
            Route("/truth.json", cameras),
            Route("/truth/{camera:path}/{frame:int}.jpg", picture),
        ],
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=list(LOOPBACK_NAMES), www_redirect=False)],
        exception_handlers={StreamError: refusing(404), CaptureError: refusing(500)},
    )
