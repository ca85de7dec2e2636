"""The folder in which a rig's processes meet on their own computer: sockets, and the key of its replies.

The folder belongs to the user of the rig's processes, and its group may enter it. Its permissions are the access control:
a program that can enter it may read and command, all others of the computer may not.
"""

from __future__ import annotations

import os
import socket
import stat
from dataclasses import dataclass
from pathlib import Path

from protocol.errors import Description, InputError

SERVICE_FOLDER = Path("/run/seldinger")
FOLDER_MODE, SOCKET_MODE, KEY_MODE = 0o750, 0o660, 0o640
# A unix socket's path holds 107 bytes; zenoh adds `.lock` to the longest name.
_LONGEST_PATH = 107
_LONGEST_NAME = "zenoh.sock.lock"


@dataclass(frozen=True)
class LocalPaths:
    """Paths in `folder`: zenoh's socket, the stop socket of the realtime process, the key that proves its replies."""

    folder: Path

    @property
    def zenoh_socket(self) -> Path:
        """Return the socket on which the model process accepts zenoh."""
        return self.folder / "zenoh.sock"

    @property
    def endpoint(self) -> str:
        """Return that socket as an endpoint of zenoh."""
        return f"unixsock-stream/{self.zenoh_socket}"

    @property
    def stop_socket(self) -> Path:
        """Return the socket on which the realtime process accepts `stop` and `status`."""
        return self.folder / "stop.sock"

    @property
    def reply_key(self) -> Path:
        """Return the file of the key with which the realtime process authenticates its replies; new at each start."""
        return self.folder / "reply.key"

    def prepare(self) -> LocalPaths:
        """Make the folder where it does not exist. Raises InputError for one in which other users could put files."""
        if len(os.fsencode(self.folder / _LONGEST_NAME)) > _LONGEST_PATH:
            longest = _LONGEST_PATH - len(_LONGEST_NAME) - 1
            raise InputError("zenoh.folder", str(self.folder), f"a path of at most {longest} bytes, as unix sockets need")
        try:
            self.folder.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
            found = self.folder.lstat()
        except OSError as error:
            what = Description(f"{self.folder}: {error.strerror}")
            raise InputError("zenoh.folder", what, "a folder that this user can make or owns") from None
        if not stat.S_ISDIR(found.st_mode) or found.st_uid not in (os.geteuid(), 0) or found.st_mode & 0o002:
            what = Description(f"{self.folder} of user {found.st_uid}, mode {stat.S_IMODE(found.st_mode):04o}")
            wanted = f"a folder of user {os.geteuid()} that others cannot write (chmod o-w), not a link"
            raise InputError("zenoh.folder", what, wanted)
        return self


def local_paths(rig_name: str, folder: str = "") -> LocalPaths:
    """Return the paths of a rig: in `folder`, or where none is given in the folder that this computer has for it.

    That is the installed service's, else one below XDG_RUNTIME_DIR, else one of this user in the folder of temporary files.
    """
    if folder:
        return LocalPaths(Path(folder))
    if SERVICE_FOLDER.is_dir():
        return LocalPaths(SERVICE_FOLDER)
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    own = Path(runtime) / "seldinger" if runtime else Path(f"/tmp/seldinger-{os.geteuid()}")
    return LocalPaths(own / rig_name)


def listens(path: Path) -> bool:
    """Return whether a process listens at the unix socket `path`; one that a killed process left does not count."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
        except PermissionError:  # of another user's rig: it is there
            return True
        except OSError:
            return False
        return True
