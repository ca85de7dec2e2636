"""Bad input in one line: which key, what was found, what is accepted."""

from __future__ import annotations

import json
from collections.abc import Collection


class InputError(ValueError):
    """Input that must not reach a kernel or a motor.

    The command line prints it as one line and exits with status 2. Any other exception is a programming error: it keeps
    its traceback and exits with status 1.

    key: the name of the offending input (key, file or option). found: its value. wanted: what is accepted.
    """

    def __init__(self, key: str, found: object, wanted: str) -> None:
        self.key, self.found, self.wanted = key, found, wanted
        super().__init__(f"{key}: found {_short(found)}, wanted {wanted}")

    @classmethod
    def from_sentence(cls, sentence: str) -> InputError:
        """The error that a sentence "KEY: found FOUND, wanted WANTED" describes (validators can only raise sentences)."""
        error = cls.__new__(cls)
        error.key, _, rest = sentence.partition(": found ")
        error.found, _, error.wanted = rest.partition(", wanted ")
        ValueError.__init__(error, sentence)
        return error

    def in_file(self, path: object) -> InputError:
        """The same error with the name of the file that holds the key."""
        return self if str(path) in self.key else InputError.from_sentence(f"{path}: {self}")

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return InputError.from_sentence, (str(self),)


class Description(str):
    """A description of what was found: printed without the quotes of a value."""


def reason(error: Exception) -> Description:
    """Say why a file could not be read, without the number and the path that the system's message adds."""
    return Description(getattr(error, "strerror", None) or str(error) or type(error).__name__)


def one_of(key: str, value: object, allowed: Collection[str]) -> str:
    """Return `value` if it is one of `allowed`. Raises InputError named `key`."""
    if not isinstance(value, str) or value not in allowed:
        found = value if isinstance(value, str) else str(value)
        raise InputError(key, found, any_of(allowed))
    return value


def any_of(allowed: Collection[str]) -> str:
    """Return the words of `allowed` as what an error wants."""
    return " or ".join(allowed) if len(allowed) < 4 else "one of " + ", ".join(allowed)


def _short(value: object, limit: int = 80) -> str:
    if isinstance(value, Description):
        return str(value)
    text = (
        json.dumps(value, default=str) if isinstance(value, (dict, list, str, int, float, bool, type(None))) else str(value)
    )
    return text if len(text) <= limit else text[: limit - 3] + "..."
