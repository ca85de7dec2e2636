"""Entry of the command `seldinger`: a signal during its imports ends it without a traceback.

It is not in one of the packages, because to import a package of the project takes some 20 ms before its first module runs.
`_signal` is the compiled part of `signal`, which the interpreter already holds; `signal` itself imports `enum`.
"""

import _signal
import os

# Exit status after Ctrl-C or SIGTERM, the same as in `host.cli.main`.
INTERRUPTED = 130


def _end(number: int, frame: object) -> None:
    """End the process at once: it has not started, opened or moved anything."""
    os._exit(INTERRUPTED)


def main() -> None:
    """Run the command line, which takes over SIGINT and SIGTERM as soon as it is imported. Ignored signals stay ignored."""
    if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
        _signal.signal(_signal.SIGINT, _end)
    if _signal.getsignal(_signal.SIGTERM) == _signal.SIG_DFL:
        _signal.signal(_signal.SIGTERM, _end)
    from host.cli.main import main as run

    run(_end)
