"""Prints every function that the compiled loop with the real tick calls; a script, as only fresh code can be looked at."""

import re
import sys
from typing import Any

from realtime.control import records
from realtime.control.tick import tick
from realtime.core import control_loop
from realtime.loop.clock import Clock
from realtime.loop.loop_thread import NativeLoop, input_mailboxes


def called_by(dispatcher: Any) -> set[str]:
    """Names called from the machine code of `dispatcher`, its wrappers for the interpreter left out."""
    names: set[str] = set()
    for signature in dispatcher.signatures:
        text = dispatcher.inspect_llvm(signature)
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
    for name, module in sorted(sys.modules.items()):
        if name.startswith(("realtime.", "protocol.")):
            for item in vars(module).values():
                if hasattr(item, "inspect_llvm"):
                    found |= called_by(item)
    print("\n".join(sorted(name for name in found if not name.startswith(("_ZN", "llvm.")))))


if __name__ == "__main__":
    main()
