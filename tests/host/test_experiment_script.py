"""Experiment scripts: checked against the rig before anything moves, run in virtual time, refused in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from host.cli.experiment import experiment
from host.commissioning.experiment_script import Script, check_script, perform, read_script, write_script
from host.recordings.recording import RecordingFile
from host.run.experiment_run import run_simulated
from protocol.commander import Acknowledgement
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, load_rig

RIG = load_rig(SIMULATED_RIG)
FREE: dict[str, Any] = {
    "says": "a short way", "rig": "simulated", "catheter": "blazer_prime_xp", "motion": "free",
    "start_m": [0.0, -0.006, 0.018], "rows": [[round(0.1 * k, 1), round(0.0005 * k, 4), -0.006, 0.018] for k in range(8)],
}  # fmt: skip
PRESS: dict[str, Any] = {
    **FREE, "motion": "contact", "start_m": [0.0, -0.0107, 0.021], "touch_m": [0.0, -0.0107, 0.025],
    "rows": [[0.0, 0.1], [1.0, 0.2], [2.0, 0.15]],
}  # fmt: skip


class RigControl:
    """A rig that obeys at once, and remembers what it was asked."""

    def __init__(self, refuse: str = "", mode: str = "") -> None:
        self.asked: list[tuple[str, str]] = []
        self.refuse, self.fixed, self.at = refuse, mode, 0.0
        self.tip: list[float] = [0.0, 0.0, 0.0]
        self.doing = "hold"

    def give(self, action: str, target: str = "none", **fields: Any) -> Acknowledgement:
        self.asked.append((action, target))
        if target == self.refuse or action == self.refuse:
            return Acknowledgement(False, "refused: no", "refused")
        if target in ("position", "contact"):
            self.doing, self.tip = target, list(fields["target_m"])
        return Acknowledgement(True, "", "accepted")

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        self.at += seconds
        return until()

    def now_s(self) -> float:
        return self.at

    def mode(self) -> str:
        return self.fixed or self.doing

    def tip_m(self) -> list[float]:
        return self.tip


def test_a_script_written_is_read_back(tmp_path: Path) -> None:
    for content in (FREE, PRESS):
        script = Script(**content)
        assert read_script(write_script(script, tmp_path / "s.toml")) == script


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"rig": "another"}, "rig"),
        ({"catheter": "livewire"}, "catheter"),
        ({"rows": [[0.0, 0.0, 0.0, 0.02], [0.0, 0.0, 0.0, 0.02]]}, "rows"),
        ({"rows": [[0.0, 0.0, -0.006, 0.018], [0.01, 0.0, -0.006, 0.018]]}, "rows"),
        ({"rows": [[0.0, 0.0, -0.006, 0.018], [700.0, 0.0, -0.006, 0.018]]}, "rows"),
        ({"rows": [[0.0, 0.0, -0.006, 0.018], [0.1, 0.0, -0.016, 0.018]]}, "rows"),
        ({"rows": [[0.0, 0.0, -0.006, 0.018], [1.0, 0.0, -0.006, 0.3]]}, "rows.1"),
        ({"start_m": [0.2, 0.0, 0.0]}, "start_m"),
        ({"rows": [[20.0 * k, 0.0, -0.006, 0.018 + 0.04 * k] for k in range(5)]}, "rows (insertion)"),
    ],
)
def test_what_the_rig_must_not_do_is_bad_input(change: dict[str, Any], key: str) -> None:
    check_script(Script(**FREE), RIG)
    with pytest.raises(InputError) as error:
        check_script(Script(**{**FREE, **change}), RIG)
    assert error.value.key == key


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"rows": [[0.0, 0.1], [1.0, 0.45]]}, "rows"),
        ({"rows": [[0.0, 0.001], [1.0, 0.1]]}, "rows"),
        ({"into": [0.0, 0.0, 2.0]}, "into"),
        ({"touch_m": []}, "touch_m"),
    ],
)
def test_a_force_the_rig_must_not_hold_is_bad_input(change: dict[str, Any], key: str) -> None:
    assert check_script(Script(**PRESS), RIG).forces_N == (0.1, 0.2)
    with pytest.raises(InputError) as error:
        check_script(Script(**{**PRESS, **change}), RIG)
    assert error.value.key == key


def test_a_file_that_is_no_script_is_bad_input(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    for text, key in (("rows = [", "script"), ('says = "x"', f"{path}: rig")):
        path.write_text(text)
        with pytest.raises(InputError) as error:
            read_script(path)
        assert error.value.key == key
    write_script(Script(**FREE), path)
    good = path.read_text()
    path.write_text(f"more = 1\n{good}")
    with pytest.raises(InputError, match="more"):
        read_script(path)
    path.write_text(good.replace("0.700,", "0.700, 1.0,"))
    with pytest.raises(InputError, match=r"rows.7"):
        read_script(path)
    with pytest.raises(InputError, match="script"):
        read_script(tmp_path / "none.toml")


def test_commands_come_in_order_and_a_contact_ends_with_a_retract() -> None:
    control = RigControl()
    perform(Script(**FREE), control)
    assert control.asked == [("target", "position")] * 9
    control = RigControl()
    perform(Script(**PRESS), control)
    assert control.asked == [("target", "position"), ("target", "contact"), *[("force", "none")] * 3, ("target", "retract")]


@pytest.mark.parametrize("control", [RigControl(refuse="position"), RigControl(refuse="force"), RigControl(mode="stopped")])
def test_a_refusal_or_a_stop_breaks_it_off_and_holds(control: RigControl) -> None:
    with pytest.raises(RuntimeError):
        perform(Script(**PRESS), control)
    assert control.asked[-1] == ("hold", "none") and ("target", "retract") not in control.asked


def test_without_go_nothing_is_commanded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    experiment(write_script(Script(**FREE), tmp_path / "s.toml"), json=True)
    out, err = capsys.readouterr()
    assert '"good": true' in out and "nothing has moved" in err and "roll: " in err
    with pytest.raises(InputError, match="--go"):
        experiment(tmp_path / "s.toml", go=True, simulated=True)


@pytest.mark.slow
def test_the_simulated_rig_goes_where_the_script_says(tmp_path: Path) -> None:
    recording = RecordingFile(run_simulated(Script(**FREE), RIG, tmp_path, "native", 1, ()))
    tip = recording.table("pose/tip")
    last = tip["x_m"][-40:]
    assert last.mean() == pytest.approx(0.0035, abs=3e-4)
    assert {row["action"] for row in recording.messages("command")} == {"take", "arm", "target", "disarm"}
    with pytest.raises(InputError, match="--effect"):
        run_simulated(Script(**FREE), RIG, tmp_path, "native", 1, ("backlash@nowhere",))
