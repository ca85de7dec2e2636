"""Commands to a running rig: arm, jog, goto, touch, ... Each takes the lease, asks, and prints the rig's answer."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, RigFile
from host.cli.quantities import direction, meant, point, positive, quantity
from protocol.enums import JogAxis
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG

if TYPE_CHECKING:
    from host.run.connection import RigConnection
    from protocol.topics import Message

Name = Annotated[str, typer.Option("--name", help="Name of the commander.")]
Endpoint = Annotated[str | None, typer.Option(help="Address of a rig on another machine: tls/HOST:PORT.")]
Keys = Annotated[Path | None, typer.Option(help="Folder of the certificate for --endpoint.")]
Force = Annotated[str, typer.Option(help="Contact force, such as 0.2, 200mN or 20g.")]
# Of jogs along a direction of the base frame.
TIP_DIRECTIONS = {
    "e1": (1.0, 0.0, 0.0),
    "e2": (0.0, 1.0, 0.0),
    "e3": (0.0, 0.0, 1.0),
}
# Beyond these a number is a slip; what the rig accepts is narrower, and its answer says so.
FASTEST_PER_S, WIDEST_M, LONGEST_S, MOST_N = 10.0, 0.1, 3600.0, 1.0
LOOK_S = 0.02
RETRACTED = "retracted and stopped; disarm and arm to move again"
# A goal is reached when the tip has been near it for so long.
THERE_S = 0.3
ANSWERS_WITHIN_S = 3.0
# A rig of this computer that has no socket does not run: that is said after this time instead.
NOT_RUNNING_S = 0.2


class Driver:
    """One command to a rig: the request, the rig's answer, and the progress of the motion."""

    def __init__(self, connection: RigConnection, command: str, json: bool) -> None:
        self.rig, self._command, self._json = connection, command, json
        self.result: dict[str, Any] = {"command": command, "accepted": True}

    @property
    def state(self) -> Any:
        """The newest state of the loop."""
        return self.rig.latest("state")

    def say(self, text: str) -> None:
        """Print `text` with the command's name on standard error."""
        print(f"{self._command}: {text}", file=sys.stderr, flush=True)

    def wait(self, seconds: float, done: Callable[[Message], bool]) -> bool:
        """Wait until the rig's state fulfils `done`; false after `seconds`, or where the rig stops."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            state = self.state
            if state is not None and done(state):
                return True
            time.sleep(LOOK_S)
        return False

    def failed(self, text: str) -> typer.Exit:
        """Note that the command was accepted but not completed; the exit status is 1."""
        why = self.why()
        self.result |= {"done": False, "text": text + why}
        self.say(text + why)
        return typer.Exit(1)

    def why(self) -> str:
        """Return the end of a sentence with the first cause of what holds the rig back; empty if nothing does."""
        state = self.state
        if state is None:
            return ""
        cause = self.rig.first_cause()
        if cause:
            return f"; first cause: {cause}"
        return "" if state.safety_action in ("none", "warn") else f"; safety: {state.cause}"

    def finish(self) -> None:
        """Print the result as one JSON object on standard output, if `--json` is given."""
        state = self.state
        if state is not None:
            self.result |= {"phase": state.mode, "tip_m": state.tip_m, "force_N": state.force_N}
        if self._json:
            write_json(self.result)


@contextlib.contextmanager
def driving(
    command: str, rig: Path, json: bool, name: str, endpoint: str | None, keys: Path | None, lease: bool = True
) -> Iterator[Driver]:
    """Connect, take the lease where it is needed, and give it back at the end. A refusal ends with exit status 1.

    Raises InputError (exit status 2) if the rig does not run: nothing was commanded.
    """
    from host.run.connection import CommandRefused, connect, may_run, not_running

    with connect(rig, name, endpoint=endpoint, keys=keys) as connection:
        driver = Driver(connection, command, json)
        try:
            may = endpoint is not None or may_run(connection.rig)
            seen = driver.wait(ANSWERS_WITHIN_S if may else NOT_RUNNING_S, lambda state: True)
            # A hold is sent to a rig that may run, even if its states do not come.
            if not seen and (lease or not may):
                error = not_running(connection.rig, endpoint)
                driver.result |= {"accepted": False, "text": str(error)}
                raise error
            if lease:
                connection.take()
            yield driver
        except CommandRefused as refused:
            answer = refused.acknowledgement
            # Why the rig does not move says nothing about a lease that another commander holds.
            why = "" if refused.action == "take" else driver.why()
            driver.result |= {"accepted": False, "text": answer.reason + why}
            print(f"seldinger: {command}: {answer.reason}{why}", file=sys.stderr)
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            connection.hold()
            driver.say("the rig holds")
            driver.result |= {"done": False, "text": "interrupted; the rig holds"}
            raise
        finally:
            driver.finish()


def _plain(command: str, words: str, lease: bool = True) -> Callable[..., None]:
    """Make the command that gives the rig one word and prints its answer."""

    def run(
        rig: RigFile = SIMULATED_RIG,
        json: Json = False,
        name: Name = "console",
        endpoint: Endpoint = None,
        keys: Keys = None,
    ) -> None:
        with driving(command, rig, json, name, endpoint, keys, lease) as driver:
            getattr(driver.rig, "clear_fault" if command == "clear" else command)()
            driver.say(words)

    run.__doc__ = words
    return run


disarm = _plain("disarm", "accepted; the stages come to rest and the board is disarmed")
hold = _plain("hold", "accepted; the rig holds its position", lease=False)
clear = _plain("clear", "accepted; latched causes and faults are cleared, the rig is disarmed")
zero = _plain("zero", "accepted; the present load of the force sensor is its zero now")


def arm(
    rig: RigFile = SIMULATED_RIG, json: Json = False, name: Name = "console", endpoint: Endpoint = None, keys: Keys = None
) -> None:
    """Power the stages; they hold their position."""
    with driving("arm", rig, json, name, endpoint, keys) as driver:
        driver.rig.arm()
        if not driver.wait(ANSWERS_WITHIN_S, lambda state: state.mode == "hold"):  # type: ignore[attr-defined]
            raise driver.failed("accepted, but the loop does not hold")
        driver.say("accepted; the rig holds")


def jog(
    axis: Annotated[
        str, typer.Argument(help="Axis (insertion, roll, knob), or direction of the tip (e1, e2, e3 or X,Y,Z).")
    ],
    travel: Annotated[
        list[str], typer.Argument(help="Distance or angle, such as 2mm, -0.002, 5deg; the sign is the direction.")
    ],
    speed: Annotated[str | None, typer.Option(help="Speed, such as 5mm (per second). Default: half of the maximum.")] = None,
    rig: RigFile = SIMULATED_RIG,
    json: Json = False,
    name: Name = "console",
    endpoint: Endpoint = None,
    keys: Keys = None,
) -> None:
    """Move one axis, or the tip along a direction, a short way. It ends where the tip touches something."""
    along: tuple[float, float, float] | None = None
    if axis in ("insertion", "roll", "knob"):
        what = JogAxis[axis.upper()]
    else:
        what, along = JogAxis.TIP, TIP_DIRECTIONS.get(axis)
        if along is None:
            if axis.count(",") != 2:
                raise InputError("axis", axis, "insertion, roll, knob, e1, e2, e3, or a direction X,Y,Z")
            along = direction("axis", axis)
    from protocol.jog_limits import LONGEST_JOG, unit_of

    unit, most = unit_of(what), LONGEST_JOG[what]
    text = " ".join(travel)
    way = quantity("travel", text, unit)
    if not 0.0 < abs(way) <= most:
        hint = meant(text, unit, lambda number: 0.0 < abs(number) <= most)
        raise InputError("travel", text, f"other than 0, at most {most:g} {unit} either way{hint}")
    pace = None if speed is None else positive("--speed", speed, unit, FASTEST_PER_S, "per second")
    with driving("jog", rig, json, name, endpoint, keys) as driver:
        driver.rig.jog(what.label, way, pace, along)
        driver.wait(0.5, lambda state: state.mode == "jog")  # type: ignore[attr-defined]
        if not driver.wait(60.0, lambda state: state.mode != "jog"):  # type: ignore[attr-defined]
            raise driver.failed("the jog has not ended within 60 s")
        state = driver.state
        if state.mode != "hold":
            raise driver.failed(f"ended in phase {state.mode}")
        driver.say(f"done; tip at {_mm(state.tip_m)}, force {state.force_N:.3f} N")


def goto(
    place: Annotated[list[str], typer.Argument(help="Point X,Y,Z of the base frame, such as 0,-10.7mm,21mm.")],
    tolerance: Annotated[str, typer.Option(help="Largest accepted distance from the point.")] = "1mm",
    within: Annotated[str, typer.Option(help="Longest time to get there.")] = "20s",
    rig: RigFile = SIMULATED_RIG,
    json: Json = False,
    name: Name = "console",
    endpoint: Endpoint = None,
    keys: Keys = None,
) -> None:
    """Bring the tip to a point in free space and stay there. Ctrl-C holds."""
    goal_m, near_m, seconds = (
        point("place", place),
        positive("--tolerance", tolerance, "m", WIDEST_M),
        positive("--within", within, "s", LONGEST_S),
    )
    with driving("goto", rig, json, name, endpoint, keys) as driver:
        driver.rig.goto(goal_m)
        since_s: float | None = None

        def there(state: Any) -> bool:
            nonlocal since_s
            if state.mode not in ("position", "hold"):
                return True
            near = state.tip_m is not None and math.dist(state.tip_m, goal_m) <= near_m
            since_s = (since_s or time.monotonic()) if near else None
            return since_s is not None and time.monotonic() - since_s >= THERE_S

        reached = driver.wait(seconds, there)
        state = driver.state
        off_m = math.dist(state.tip_m, goal_m) if state.tip_m is not None else math.nan
        driver.result |= {"done": reached and state.mode == "position", "error_m": off_m}
        if not driver.result["done"]:
            raise driver.failed(f"not reached: {1e3 * off_m:.1f} mm off, phase {state.mode}")
        driver.say(f"reached: {1e3 * off_m:.1f} mm off")


def touch(
    place: Annotated[list[str], typer.Argument(help="Point X,Y,Z on the tissue, base frame, such as 0,-10.7mm,25mm.")],
    normal: Annotated[str, typer.Option(help="Direction X,Y,Z into the tissue.")] = "0,0,1",
    force: Force = "0.2",
    seconds: Annotated[
        str | None,
        typer.Option("--for", help="Time after which the tip is retracted. Default: press until the next command."),
    ] = None,
    within: Annotated[str, typer.Option(help="Longest time until contact.")] = "20s",
    rig: RigFile = SIMULATED_RIG,
    json: Json = False,
    name: Name = "console",
    endpoint: Endpoint = None,
    keys: Keys = None,
) -> None:
    """Approach the tissue along a normal and hold a force on it. Ctrl-C holds."""
    goal_m, into, force_N = point("place", place), direction("--normal", normal), positive("--force", force, "N", MOST_N)
    hold_s = None if seconds is None else positive("--for", seconds, "s", LONGEST_S)
    patience_s = positive("--within", within, "s", LONGEST_S)
    with driving("touch", rig, json, name, endpoint, keys) as driver:
        driver.rig.touch(goal_m, into, force_N)
        began_s = time.monotonic()
        ended = ("contact", "stopped", "retract", "disarmed")
        if not driver.wait(patience_s, lambda state: state.mode in ended) or driver.state.mode != "contact":  # type: ignore[attr-defined]
            driver.rig.hold()
            took_s = time.monotonic() - began_s
            held = "" if driver.state.mode in ("stopped", "disarmed") else "; the rig holds"
            raise driver.failed(f"no contact after {took_s:.1f} s, phase {driver.state.mode}{held}")
        driver.say(f"in contact, {force_N:g} N wanted")
        if hold_s is None:
            driver.say("the force is held until hold, retract or stop")
            return
        mean_N, settle_s = settled_mean(_pressed(driver, hold_s))
        driver.result |= {"mean_force_N": mean_N, "settle_s": settle_s, "seconds": hold_s}
        if driver.state.mode in ("stopped", "disarmed", "retract"):
            raise driver.failed(f"the touch ended early, phase {driver.state.mode}")
        driver.rig.retract()
        driver.wait(5.0, lambda state: state.mode == "stopped")  # type: ignore[attr-defined]
        driver.say(f"mean force {mean_N:.3f} N of {force_N:g} N, without the first {settle_s:.1f} s; {RETRACTED}")


def settled_mean(forces: Sequence[tuple[int, float]]) -> tuple[float, float]:
    """Return the mean force (N) of a touch after its begin, and how much of it (s) was left out, as in a protocol.

    forces: time (ns) and force (N) of each state. The force rises slowly, so the first 1.5 s (of a short touch the first
    half) do not show what is held.
    """
    from host.run.protocol_file import SETTLE_S

    if not forces:
        return math.nan, 0.0
    first_ns, last_ns = forces[0][0], forces[-1][0]
    settle_ns = min(round(SETTLE_S * 1e9), (last_ns - first_ns) // 2)
    kept = [force_N for stamp_ns, force_N in forces if stamp_ns - first_ns >= settle_ns]
    return sum(kept) / len(kept), settle_ns * 1e-9


def _pressed(driver: Driver, seconds: float) -> list[tuple[int, float]]:
    """Return time (ns) and force (N) of the states in so many seconds of a touch, or until it ends."""
    forces: list[tuple[int, float]] = []
    seen = -1

    def ended(state: Any) -> bool:
        nonlocal seen
        if state.stamp_ns != seen and state.force_N is not None:
            seen = state.stamp_ns
            forces.append((seen, state.force_N))
        return state.mode in ("stopped", "disarmed", "retract")

    driver.wait(seconds, ended)
    return forces


def force(
    newton: Annotated[list[str], typer.Argument(help="Contact force, such as 0.15, 150mN or 15g.")],
    rig: RigFile = SIMULATED_RIG,
    json: Json = False,
    name: Name = "console",
    endpoint: Endpoint = None,
    keys: Keys = None,
) -> None:
    """Change the force of the present touch."""
    force_N = positive("newton", " ".join(newton), "N", MOST_N)
    with driving("force", rig, json, name, endpoint, keys) as driver:
        driver.rig.force(force_N)
        driver.say(f"accepted; {force_N:g} N wanted")


def retract(
    rig: RigFile = SIMULATED_RIG, json: Json = False, name: Name = "console", endpoint: Endpoint = None, keys: Keys = None
) -> None:
    """Withdraw the tip from the tissue, then stop."""
    with driving("retract", rig, json, name, endpoint, keys) as driver:
        driver.rig.retract()
        if not driver.wait(10.0, lambda state: state.mode == "stopped"):  # type: ignore[attr-defined]
            raise driver.failed("accepted, but not retracted within 10 s")
        driver.say("done; the rig has stopped. To continue, disarm and arm it")


def mark(
    note: Annotated[str, typer.Argument(help="Text of the note, at most 500 characters.")],
    rig: RigFile = SIMULATED_RIG,
    json: Json = False,
    name: Name = "console",
    endpoint: Endpoint = None,
    keys: Keys = None,
) -> None:
    """Write a note with the rig's time into log and recording."""
    if not 0 < len(note.strip()) <= 500 or not note.isprintable():
        raise InputError("note", note, "1 to 500 characters that can be printed, on one line")
    with driving("mark", rig, json, name, endpoint, keys, lease=False) as driver:
        driver.rig.mark(note)
        driver.say("noted")


def status(rig: RigFile = SIMULATED_RIG, json: Json = False, endpoint: Endpoint = None, keys: Keys = None) -> None:
    """Show a running rig on one screen, the first cause of what holds it back first. Commands nothing."""
    from host.run.connection import may_run, not_running, open_session
    from host.run.rig_status import read_status
    from protocol.rig_file import load_rig

    read = load_rig(rig)
    with open_session(read, endpoint, keys) as session:
        patience_s = ANSWERS_WITHIN_S if endpoint is not None or may_run(read) else NOT_RUNNING_S
        found = read_status(session, read.name, wait_s=patience_s)
    if json:
        write_json(found.as_json())
    elif found.connected:
        print("\n".join(found.lines()))
    if not found.connected:
        raise not_running(read, endpoint)


def _mm(point_m: Any) -> str:
    return "an unknown place" if point_m is None else ", ".join(f"{1e3 * value:.1f}" for value in point_m) + " mm"
