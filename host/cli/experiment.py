"""`seldinger experiment SCRIPT`: the script of a diagnosis, checked and shown; it moves only with --go or --simulated."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress

from host.cli.contract_io import BadInput, write_json
from host.demo import SIMULATED_RIG, new_recording_path, simulated_plant
from host.experiment_script import Path3D, Script, check_script, perform, read_script
from protocol.commander import Acknowledgement
from protocol.topics import MODES, Message, RigState
from realtime.rig_file import AXES, Rig, load_rig
from sim.effects import parse

ARM_WITHIN_S = 10.0


def experiment(
    script: Annotated[Path, typer.Argument(help="Script (TOML), as `seldinger diagnose --out` writes it.")],
    rig: Annotated[Path, typer.Option(help="Rig file.")] = SIMULATED_RIG,
    go: Annotated[bool, typer.Option("--go", help="Command the running rig: take the lease, arm, move.")] = False,
    simulated: Annotated[bool, typer.Option("--simulated", help="Run it in virtual time on the simulated rig.")] = False,
    effect: Annotated[list[str] | None, typer.Option(help="With --simulated: plant an effect, as in `demo`.")] = None,
    board: Annotated[str, typer.Option(help="With --simulated: avr, native, or auto.")] = "auto",
    seed: Annotated[int, typer.Option(help="With --simulated: of all noise.")] = 1,
    directory: Annotated[Path, typer.Option("--dir", help="With --simulated: where the recording goes.")] = Path("runs"),
    json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Check a script against the rig's limits and show what it does; with --go or --simulated, do it."""
    if go and simulated:
        raise BadInput("--go", "both --go and --simulated", "one of them")
    loaded, wanted = load_rig(rig), read_script(script)
    path = check_script(wanted, loaded)
    show(wanted, path, loaded)
    result: dict[str, Any] = {"script": str(script), "good": True, "seconds": path.seconds, "recording": None}
    if not (go or simulated):
        print("nothing was moved: --go commands the running rig, --simulated runs it in virtual time", file=sys.stderr)
    try:
        with Progress(console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("experiment", total=1.0)

            def progress(share: float) -> None:
                bar.update(task, completed=share)

            if simulated:
                recording = run_simulated(wanted, loaded, directory, board, seed, tuple(effect or ()), progress)
                result["recording"] = str(recording)
                print(f"recording: {recording}", file=sys.stderr)
            elif go:
                run_live(wanted, loaded, progress)
    except RuntimeError as error:
        print(f"seldinger: experiment: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    if json:
        write_json(result)


def show(script: Script, path: Path3D, rig: Rig) -> None:
    """What the script does, on standard error."""
    ends = zip("xyz", 1e3 * path.low_m, 1e3 * path.high_m, strict=True)
    box = ", ".join(f"{axis} {low:.1f} to {high:.1f}" for axis, low, high in ends)
    rows = [
        script.says,
        f"{script.motion} motion, {len(script.rows)} commands in {path.seconds:.0f} s",
        f"tip (mm): {box}; fastest {1e3 * path.fastest_m_per_s:.1f} mm/s",
    ]
    for axis, name in enumerate(AXES):
        low, high = path.travel[name]
        rows.append(f"{name}: {low:.4g} to {high:.4g} of {rig.stage(axis).min_unit} to {rig.stage(axis).max_unit}")
    if script.motion == "contact":
        rows.append(f"force: {path.forces_N[0]:.3g} to {path.forces_N[1]:.3g} N, over-force at {rig.safety.over_force_N} N")
    print("\n".join(rows), file=sys.stderr)


class VirtualDesk:
    """A `sim.scenario.Scenario` as a desk."""

    def __init__(self, scenario: Any) -> None:
        self._scenario = scenario

    def give(self, action: str, target: str = "none", **fields: Any) -> Acknowledgement:
        """As Scenario.command."""
        answer: Acknowledgement = self._scenario.command(action, target, **fields)
        return answer

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """As Scenario.run."""
        return bool(self._scenario.run(seconds, until))

    def now_s(self) -> float:
        """Virtual time."""
        return float(self._scenario.now_ns * 1e-9)

    def mode(self) -> str:
        """The loop's phase."""
        return MODES[self._scenario.phase]

    def tip_m(self) -> Sequence[float]:
        """The tip as the loop predicts it."""
        return [float(v) for v in self._scenario.loop.outputs[0].tip_m]


def run_simulated(script: Script, rig: Rig, directory: Path, board: str, seed: int, effects: tuple[str, ...],
                  progress: Callable[[float], None] = lambda share: None) -> Path:  # fmt: skip
    """Perform `script` on the simulated rig in virtual time; the recording. Raises BadInput, RuntimeError."""
    from host.estimator_process import header_of
    from host.recording import RecordingWriter
    from sim.board import Board
    from sim.scenario import Scenario
    from sim.world import World

    try:
        plant = simulated_plant(rig, seed, effects=tuple(map(parse, effects)))
    except ValueError as error:
        found, _, wanted = str(error).partition(": found ")[2].partition(", wanted ")
        raise BadInput("--effect", found, wanted) from None
    target = new_recording_path(directory, "experiment")
    with Board(board) as made, RecordingWriter(target, header_of(rig, "virtual", seed, {"job": script.says})) as recording:
        world = World(rig, plant, made, seed)

        def record(topic: str, message: Message) -> None:
            recording.write(topic, message, world.now_ns)

        scenario = Scenario(rig, world, record)
        scenario.run(REST_BEFORE_S)
        if not scenario.arm():
            raise RuntimeError("devices not ready")
        desk = VirtualDesk(scenario)
        perform(script, desk, progress)
        desk.give("disarm")
        scenario.run(0.1)
    return target


REST_BEFORE_S = 4.0  # stillness, from which a diagnosis takes the noise


class LiveDesk:
    """A running rig over zenoh as a desk."""

    def __init__(self, session: Any, commander: Any) -> None:
        self._states, self._commander = session.latest("state"), commander
        self._state: RigState | None = None

    def give(self, action: str, target: str = "none", **fields: Any) -> Acknowledgement:
        """As Commander.give."""
        answer: Acknowledgement = self._commander.give(action, target, **fields)
        return answer

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """On the wall clock, looking every 10 ms; ends where the lease was lost."""
        end = time.monotonic() + seconds
        while True:
            self._look()
            if until():
                return True
            if time.monotonic() >= end:
                return False
            if self._commander.lost:
                raise RuntimeError(f"lease lost: {self._commander.lost}")
            time.sleep(min(0.01, max(end - time.monotonic(), 0.0)))

    def _look(self) -> None:
        state = self._states.take()
        if isinstance(state, RigState):
            self._state = state

    def now_s(self) -> float:
        """CLOCK_MONOTONIC."""
        return time.monotonic()

    def mode(self) -> str:
        """The loop's phase, empty before it was heard of."""
        self._look()
        return self._state.mode if self._state else ""

    def tip_m(self) -> Sequence[float] | None:
        """The tip as the loop predicts it."""
        tip_m = self._state.tip_m if self._state else None
        return None if tip_m is None else [float(v) for v in tip_m]


def run_live(script: Script, rig: Rig, progress: Callable[[float], None]) -> None:
    """Perform `script` on the running rig of the rig file; its own services record. Raises RuntimeError."""
    from host.commander import Commander
    from protocol.zenoh_session import Session

    with Session(rig.name, [], rig.zenoh.connect) as session, Commander(session, "experiment") as commander:
        desk = LiveDesk(session, commander)
        taken = commander.take()
        if not taken.accepted:
            raise RuntimeError(f"lease: {taken.reason}")
        if not desk.wait(2.0, lambda: desk.mode() != ""):
            raise RuntimeError("no state heard from the rig")
        if desk.mode() == "disarmed":
            armed = commander.arm()
            if not armed.accepted or not desk.wait(ARM_WITHIN_S, lambda: desk.mode() == "hold"):
                raise RuntimeError(f"not armed: {armed.reason or 'the loop does not hold'}")
        try:
            perform(script, desk, progress)
        finally:
            commander.disarm()
