# SPDX-License-Identifier: Apache-2.0
"""Where complete sets wait for the trainer: the newest one in memory, or all of them in a queue on the disk."""

import logging
import re
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from structgstream.data.live.matching import PictureSet, SetTimes
from structgstream.data.live.picture_file import read_pictures, write_pictures
from structgstream.errors import CaptureError, StorageError
from structgstream.frames import MultiViewFrame
from structgstream.owned_folders import own_folder, remove_own

log = logging.getLogger(__name__)

Convert = Callable[[PictureSet], MultiViewFrame]
"""Pictures of a set as sRGB; the presentation time is the common clock's."""
GIGABYTE = 10**9
PURPOSE = "queue of a live stream"
SETS = re.compile(r"set-\d{8,}(\.partial)?")
MAX_UNWRITTEN = 8  # sets whose pictures wait in memory
ROOM_AGAIN = 0.5  # of the queue must be empty before sets are taken again, so that gaps are few


@dataclass(frozen=True)
class QueueStatus:
    """What became of complete sets.

    Args:
        waiting: sets that wait.
        waiting_bytes: of the files they wait in.
        skipped: sets that no frame was made of, because there was a newer one or no room.
    """

    waiting: int
    waiting_bytes: int
    skipped: int


class Outlet(Protocol):
    """Takes complete sets from the cameras' side and gives frames to the trainer's."""

    def put(self, found: PictureSet) -> None:
        """Takes a set."""
        ...

    def take(self, timeout_seconds: float) -> MultiViewFrame | None:
        """The next frame; None if none came in time."""
        ...

    def ahead(self, number: int, timeout_seconds: float) -> MultiViewFrame | None:
        """One of the frames to come, the next being number 0; None if it did not come in time, or is damaged.

        Where sets wait, it is taken later as well; where only the newest counts, the one that comes next is given.
        """
        ...

    @property
    def taken(self) -> SetTimes | None:
        """Times of the set that was taken last; None before the first, and for those of an earlier run."""
        ...

    @property
    def status(self) -> QueueStatus: ...

    def close(self) -> None:
        """Removes what waits."""
        ...


class Latest:
    """Holds the newest set; who asks gets that, and the ones before are skipped."""

    def __init__(self, convert: Convert) -> None:
        self._convert = convert
        self._held: PictureSet | None = None
        self._skipped = 0
        self.taken: SetTimes | None = None
        self._ready = threading.Condition()

    def put(self, found: PictureSet) -> None:
        with self._ready:
            self._skipped += self._held is not None
            self._held = found
            self._ready.notify()

    def take(self, timeout_seconds: float) -> MultiViewFrame | None:
        with self._ready:
            if self._held is None:
                self._ready.wait(timeout_seconds)
            found, self._held = self._held, None
        if found is None:
            return None
        self.taken = found.times
        return self._convert(found)

    def ahead(self, number: int, timeout_seconds: float) -> MultiViewFrame | None:
        times = self.taken
        found = self.take(timeout_seconds)
        self.taken = times
        return found

    @property
    def status(self) -> QueueStatus:
        return QueueStatus(int(self._held is not None), 0, self._skipped)

    def close(self) -> None:
        self._held = None


class DiskQueue:
    """Keeps every set in a file until the trainer takes it; a thread writes them.

    When the files reach ``max_bytes``, further sets are skipped until half of them are taken, and so are sets that
    come faster than they can be written; both are told.

    Args:
        folder: is made, and removed at the end.
        resume: whether sets that an earlier run was killed over are taken first; else they are removed.
        max_bytes: of its files.
        convert: makes a set's pictures.

    Raises:
        StorageError: the folder cannot be used.
    """

    def __init__(self, folder: Path, *, max_bytes: int, convert: Convert, resume: bool = False) -> None:
        self._folder, self._most, self._convert = folder, max_bytes, convert
        self._sets: deque[PictureSet] = deque()
        self._files: deque[tuple[Path, int, SetTimes | None]] = deque()
        self.taken: SetTimes | None = None
        self._bytes = self._skipped = 0
        self._full = self._slow = self._writing = self._closed = False
        self._failed: BaseException | None = None
        self._changed = threading.Condition()
        try:
            own_folder(folder, PURPOSE)
            for file in sorted(path for path in folder.iterdir() if SETS.fullmatch(path.name)):
                if resume and not file.suffix:  # Another name is that of a file that was being written.
                    self._files.append((file, file.stat().st_size, None))
                else:
                    file.unlink()
        except OSError as error:
            raise StorageError(f"The queue {folder} cannot be used ({error.strerror}).") from None
        self._bytes = sum(size for _, size, _ in self._files)
        self._number = int(self._files[-1][0].name.removeprefix("set-")) + 1 if self._files else 0
        self._writer = threading.Thread(target=self._write, name="queue", daemon=True)
        self._writer.start()

    def put(self, found: PictureSet) -> None:
        with self._changed:
            self._full = self._full and self._bytes > ROOM_AGAIN * self._most
            slow = len(self._sets) >= MAX_UNWRITTEN
            if self._full or slow or self._failed is not None:
                self._skipped += 1
                if slow and not self._slow:
                    self._slow = True
                    log.warning(
                        "The queue %s takes sets of pictures more slowly than they come, so some are skipped; take "
                        "smaller pictures (--scale), a faster disk, or --policy latest.",
                        self._folder,
                    )
                return
            self._sets.append(found)
            self._changed.notify_all()

    def take(self, timeout_seconds: float) -> MultiViewFrame | None:
        """The oldest set; one that a power failure has damaged, which files here are not synced against, is skipped.

        Raises:
            StorageError: the disk is full.
        """
        with self._changed:
            if not self._files and self._failed is None:
                self._changed.wait(timeout_seconds)
            if not self._files:
                if self._failed is not None:
                    raise self._failed
                return None
            path, size, self.taken = self._files.popleft()
        frame = None
        try:
            frame, _ = read_pictures(path)
        except CaptureError as error:
            log.warning("A set of pictures is lost: %s", error)
        path.unlink(missing_ok=True)
        with self._changed:
            self._bytes -= size
            self._skipped += frame is None
        return frame

    def ahead(self, number: int, timeout_seconds: float) -> MultiViewFrame | None:
        with self._changed:
            self._changed.wait_for(lambda: len(self._files) > number or self._failed is not None, timeout_seconds)
            if len(self._files) <= number:
                return None
            path = self._files[number][0]
        try:
            return read_pictures(path)[0]
        except CaptureError:
            return None

    @property
    def status(self) -> QueueStatus:
        with self._changed:
            waiting = len(self._files) + len(self._sets) + self._writing
            return QueueStatus(waiting, self._bytes, self._skipped)

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._writer.join()
        remove_own(self._folder, PURPOSE, SETS, whole=True)

    def _write(self) -> None:
        while True:
            with self._changed:
                while not self._sets and not self._closed:
                    self._changed.wait()
                if self._closed:
                    return
                found = self._sets.popleft()
                self._writing = True
            try:
                path = self._folder / f"set-{self._number:08d}"
                self._number += 1
                size = write_pictures(path, self._convert(found), sync=False)
                self._add(path, size, found.times)
            except BaseException as error:  # raised where the trainer asks for the next set
                with self._changed:
                    self._failed = error
                    self._changed.notify_all()
            finally:
                with self._changed:
                    self._writing = False

    def _add(self, path: Path, size: int, times: SetTimes) -> None:
        with self._changed:
            self._files.append((path, size, times))
            self._bytes += size
            if self._bytes >= self._most and not self._full:
                self._full = True
                log.warning(
                    "The queue %s is full: %d sets of pictures wait in %.2f GB, because training is slower than the "
                    "cameras; further sets are skipped until half of them are done. Give it more room with "
                    "--queue-gigabytes, or take --policy latest.",
                    self._folder, len(self._files), self._bytes / GIGABYTE,
                )  # fmt: skip
            self._changed.notify_all()
