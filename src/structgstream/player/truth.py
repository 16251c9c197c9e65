# SPDX-License-Identifier: Apache-2.0
"""The capture's pictures as JPEG, for the player to show beside the reconstruction."""

import threading
from collections import OrderedDict
from collections.abc import Iterator

from structgstream.data.images import opencv
from structgstream.data.source import FrameSource
from structgstream.data.wrappers import select_cameras
from structgstream.frames import MultiViewFrame

JPEG_QUALITY = 95
MOST_CACHED_BYTES = 64 * 10**6
MOST_SKIPPED = 8  # decoding and skipping up to this many frames costs less than seeking in reopened videos


class Truth:
    """Pictures of a capture, one camera and frame at a time.

    They are decoded on demand and cached. Consecutive frames of one camera are decoded without seeking.

    Args:
        source: the part of the capture that the stream was made from, at the stream's size.
        cameras: names of the cameras that both have.
        most_cached_bytes: size of the cache of encoded pictures.

    Raises:
        MissingExtraError: OpenCV, which encodes, is not installed.
    """

    def __init__(
        self, source: FrameSource, cameras: tuple[str, ...], *, most_cached_bytes: int = MOST_CACHED_BYTES
    ) -> None:
        self.cameras = cameras
        self.frames = len(source)
        self._source = source
        self._cv2 = opencv()
        self._lock = threading.Lock()
        self._open: tuple[str, int, Iterator[MultiViewFrame]] | None = None
        self._kept: OrderedDict[tuple[str, int], bytes] = OrderedDict()
        self._most_bytes = most_cached_bytes
        self.cached_bytes = 0

    def jpeg(self, camera: str, frame: int) -> bytes | None:
        """A camera's picture as JPEG; None if there is no such camera or frame, or the camera is absent from it.

        Raises:
            CaptureError: the picture cannot be read.
        """
        if camera not in self.cameras or not 0 <= frame < self.frames:
            return None
        with self._lock:
            picture = self._kept.get((camera, frame))
            if picture is None:
                picture = self._encoded(camera, frame)
                if picture is None:
                    return None
                self._keep((camera, frame), picture)
            self._kept.move_to_end((camera, frame))
            return picture

    def _keep(self, key: tuple[str, int], picture: bytes) -> None:
        self._kept[key] = picture
        self.cached_bytes += len(picture)
        while self.cached_bytes > self._most_bytes and len(self._kept) > 1:
            self.cached_bytes -= len(self._kept.popitem(last=False)[1])

    def _encoded(self, camera: str, frame: int) -> bytes | None:
        image = self._at(camera, frame).images.get(camera)
        if image is None:
            return None
        cv2 = self._cv2
        # No chroma subsampling, because pixels are compared.
        sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        wanted = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, *sampling]
        whole, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), wanted)
        assert whole, "an 8-bit picture can be encoded"
        return data.tobytes()

    def _at(self, camera: str, frame: int) -> MultiViewFrame:
        standing, self._open = self._open, None  # A decoder that raised is not used again.
        if standing is not None and standing[0] == camera and 0 <= frame - standing[1] <= MOST_SKIPPED:
            frames = standing[2]
        else:
            frames = select_cameras(self._source, (camera,)).frames(frame)
        found = next(frames)
        while found.index < frame:
            found = next(frames)
        self._open = (camera, frame + 1, frames)
        return found
