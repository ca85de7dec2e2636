"""Proof that a reply comes from the realtime process: an HMAC over its bytes, under a key that is new at each start.

Zenoh lets every program that it admits declare that it answers requests. The key lies in a file that only the group of the
rig's processes can read, so that a program outside of it cannot answer in place of the rig.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
from pathlib import Path

from protocol.local_paths import KEY_MODE

KEY_BYTES = 32


class ReplySeal:
    """Makes a key, writes it to `path` (mode 0640), and proves replies with it. Raises OSError."""

    def __init__(self, path: Path) -> None:
        self._key = secrets.token_bytes(KEY_BYTES)
        part = path.with_suffix(".part")
        part.unlink(missing_ok=True)
        with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, KEY_MODE), "wb") as file:
            os.fchmod(file.fileno(), KEY_MODE)
            file.write(self._key)
        part.replace(path)

    def prove(self, payload: bytes) -> bytes:
        """Return the proof of a reply with these bytes."""
        return hmac.digest(self._key, payload, hashlib.sha256)


def is_proved(path: Path, payload: bytes, proof: bytes) -> bool:
    """Whether `proof` is that of `payload` under the key in file `path`; false where the key cannot be read."""
    try:
        key = path.read_bytes()
    except OSError:
        return False
    return len(key) == KEY_BYTES and hmac.compare_digest(hmac.digest(key, payload, hashlib.sha256), proof)
