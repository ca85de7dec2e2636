"""Prints every function that the compiled loop with the real tick calls, the tick and its blocks included.

A script: a process of its own has compiled, or loaded from the cache, nothing but this loop.
"""

import re
from typing import Any

from realtime.control import records
from realtime.control.tick import tick
from realtime.core import control_loop
from realtime.loop.clock import Clock
from realtime.loop.loop_thread import NativeLoop, input_mailboxes


def called_by(dispatcher: Any) -> set[str]:
    """Names called from the machine code of `dispatcher`, its wrappers for the interpreter left out.

    Its library holds the code of every function that it calls, also of one that was loaded from the cache: there,
    `inspect_llvm` has no text, but the module to link with is complete.
    """
    names: set[str] = set()
    for overload in dispatcher.overloads.values():
        text = str(overload.library._get_module_for_linking())
        assert "define " in text
        for body in re.finditer(r'^define [^@]*@"?([^"(]+)"?\(.*?^}', text, re.S | re.M):
            if "cpython" not in body.group(1) and "cfunc" not in body.group(1):
                names.update(re.findall(r'(?:call|invoke)\b[^@\n]*@"?([\w.$]+)', body.group(0)))
    return names


def main() -> None:
    loop = NativeLoop(
        tick,
        records.new(records.PARAMS),
        records.new(records.STATE),
        records.INPUTS,
        records.OUTPUTS,
        input_mailboxes(records.INPUTS),
        clock=Clock.virtual(),
        period_ns=1_000_000,
        run=control_loop.run,
    )
    loop.prepare()
    found = called_by(loop._run)
    print("\n".join(sorted(name for name in found if not name.startswith(("_ZN", "llvm.")))))


if __name__ == "__main__":
    main()
