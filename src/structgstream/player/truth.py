# SPDX-License-Identifier: Apache-2.0
"""What the cameras took, as JPEG, for the player to show beside the reconstruction."""

import threading
from collections import OrderedDict
from collections.abc import Iterator

from structgstream.data.images import opencv
from structgstream.data.source import FrameSource
from structgstream.data.wrappers import select_cameras
from structgstream.frames import MultiViewFrame

JPEG_QUALITY = 95
MOST_CACHED_BYTES = 64 * 10**6
MOST_SKIPPED = 8  # frames decoded in vain cost less than opening the videos again and seeking


class Truth:
    """Pictures of a capture, one camera and frame at a time.

    They are decoded when they are asked for and kept within a bound. While one camera is asked for frame after frame,
    its video goes on being decoded where it stands.

    Args:
        source: the part of the capture that the stream was made from, at the stream's size.
        cameras: names of the cameras that both have.
        most_cached_bytes: of encoded pictures to keep.

    Raises:
        MissingExtraError: there is nothing to encode with.
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
        """The picture of a camera; None when there is no such camera or frame.

        Raises:
            CaptureError: the picture cannot be read.
        """
        if camera not in self.cameras or not 0 <= frame < self.frames:
            return None
        with self._lock:
            picture = self._kept.get((camera, frame))
            if picture is None:
                picture = self._encoded(camera, frame)
                self._keep((camera, frame), picture)
            self._kept.move_to_end((camera, frame))
            return picture

    def _keep(self, key: tuple[str, int], picture: bytes) -> None:
        self._kept[key] = picture
        self.cached_bytes += len(picture)
        while self.cached_bytes > self._most_bytes and len(self._kept) > 1:
            self.cached_bytes -= len(self._kept.popitem(last=False)[1])

    def _encoded(self, camera: str, frame: int) -> bytes:
        image = self._at(camera, frame).images[camera]
        cv2 = self._cv2
        # Colour at full resolution: people compare pixels.
        sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        wanted = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, *sampling]
        whole, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), wanted)
        assert whole, "an 8-bit picture can be encoded"
        return data.tobytes()

    def _at(self, camera: str, frame: int) -> MultiViewFrame:
        standing, self._open = self._open, None  # A decoder that raised is not asked again.
        if standing is not None and standing[0] == camera and 0 <= frame - standing[1] <= MOST_SKIPPED:
            frames = standing[2]
        else:
            frames = select_cameras(self._source, (camera,)).frames(frame)
        found = next(frames)
        while found.index < frame:
            found = next(frames)
        self._open = (camera, frame + 1, frames)
        return found
