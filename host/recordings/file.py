"""The file under a recording: a full disk cuts it back to its last whole chunk."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import BinaryIO


class GuardedFile:
    """The file under the MCAP writer: the first failed write cuts the file back to its last whole chunk and ends it."""

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._position = 0
        self._whole = 0
        self.error: OSError | None = None

    def write(self, data: bytes) -> int:
        view = memoryview(data)
        try:
            while self.error is None and len(view):
                view = view[os.write(self._fd, view) :]
        except OSError as error:
            self._fail(error)
        self._position += len(data)
        return len(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Everything written so far is whole: bring it to the disk."""
        if self.error is not None:
            return
        try:
            os.fdatasync(self._fd)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):
                self._fail(error)
                return
        self._whole = self._position

    def read_back(self) -> BinaryIO:
        """What was written so far, to read."""
        return open(f"/proc/self/fd/{self._fd}", "rb")

    def _fail(self, error: OSError) -> None:
        self.error = error
        os.ftruncate(self._fd, self._whole)

    def close(self) -> None:
        os.close(self._fd)
