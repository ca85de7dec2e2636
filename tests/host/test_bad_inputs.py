"""Bad inputs over all commands: exit status 2, one line that names the input, no traceback, and nothing is left behind.

Each case is a command line and a text that its line of output must contain. All run in this process through the program's
`main`, in a folder with the files below.
"""

from __future__ import annotations

import gzip
import json
import math
import socket
import sys
from pathlib import Path

import pytest

from host.cli import main as command_line
from protocol import compile_notice
from protocol.catheter import CATHETER_FOLDER
from protocol.rig_file import SIMULATED_RIG

RIG = SIMULATED_RIG.read_text(encoding="utf-8")
SOLVE = {"model": "cosserat", "catheter": "livewire", "insertion_m": 0.01, "curvature_per_m": 10.0}
SOLVE |= {"force_N": [0.0, 0.05, 0.0], "force_frame": "base"}
ESTIMATE = {key: SOLVE[key] for key in ("model", "catheter", "insertion_m", "curvature_per_m")}
ESTIMATE |= {
    "case": 1,
    "sensors": [{"offset_m": 0.0, "position_m": [0.06, -0.01, 0.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}],
}
MARKER = {"offset_m": 0.0, "position_m": [0.1145, -0.0283]}
SHAPE = {"insertion_m": 0.0485, "curvature_per_m": 15.7, "force_N": [0.0, -0.1197], "markers": [MARKER]}
SHAPES_HEAD = "recording,insertion_m,curvature_per_m,force_x_N,force_y_N,offset_m,x_m,y_m\n"
SHAPES_ROW = "1,0.0485,15.7,0.0,-0.1197,0.0,0.1145,-0.0283\n"
PROTOCOL = 'name = "two"\n[[steps]]\ndo = "goto"\npoint_m = [0.0, -0.0107, 0.020]\n'
SCRIPT = (
    'says = "a sweep"\nrig = "simulated"\ncatheter = "blazer_prime_xp"\nmotion = "free"\nstart_m = [0.0, -0.0107, 0.02]\n'
    "rows = [[0.0, 0.0, -0.0107, 0.02], [1.0, 0.0, -0.0107, 0.021]]\n"
)
PLAN = {"start": {"insertion_m": -0.08, "roll_rad": 0.0, "curvature_per_m": 5.0}, "goal_m": [0.0, -0.0107, 0.02]}
NOMINAL = """
name = "an axis"
kind = "axis"
[data]
time = "t"
[channels.force]
column = "force"
unit = "N"
[channels.position]
column = "position"
unit = "m"
[axis]
subsystem = "stage"
input = "force"
output = "position"
terms = ["mass", "damping", "stiffness", "offset"]
"""


def table(*, cell: str = "0.01", every: bool = False, head: str = "t,force,position") -> str:
    """A table of 400 rows, one cell (or a whole column) of which is `cell`."""
    rows = [head]
    for i in range(400):
        t = 0.01 * i
        position = cell if every or i == 200 else f"{0.01 * math.sin(3.0 * t):.6f}"
        rows.append(f"{t:.3f},{math.cos(3.0 * t):.6f},{position}")
    return "\n".join(rows) + "\n"


def rig(old: str, new: str) -> str:
    """The simulated rig's file with `old` replaced by `new`."""
    assert old in RIG, old
    return RIG.replace(old, new, 1)


CATHETER = (CATHETER_FOLDER / "blazer_prime_xp.toml").read_text(encoding="utf-8")


def catheter(old: str, new: str) -> str:
    """The catheter file of the simulated rig with `old` replaced by `new`."""
    assert old in CATHETER, old
    return CATHETER.replace(old, new, 1)


def solve(**changes: object) -> str:
    return json.dumps(SOLVE | changes)


# Name -> content. All are in the folder in which the cases run.
FILES: dict[str, str | bytes] = {
    "empty": "",
    "binary": bytes(range(256)) * 4,
    "cut.json": json.dumps(SOLVE)[:40],
    "list.json": "[1, 2, 3]",
    "deep.json": "[" * 100_000,
    "deep.toml": "x = " + "[" * 100_000,
    "utf-16": json.dumps(SOLVE).encode("utf-16"),
    "packed": gzip.compress(b"name = 1"),
    "archive": b"PK\x03\x04" + bytes(40),
    "number.json": "7",
    "cut.toml": RIG[:700],
    "other.toml": 'colour = "red"\n',
    "cut.mcap": b"\x89MCAP0\r\n" + b"\x01\x10",
    "rig.toml": RIG,
    "nominal.toml": NOMINAL,
    "good.csv": table(),
    "protocol.toml": PROTOCOL,
    "script.toml": SCRIPT,
    "shapes.json": json.dumps({"recordings": [SHAPE] * 3}),
    # solve and estimate
    "solve.json": solve(),
    "solve-mm.json": solve(insertion_m=50.0),
    "solve-text.json": solve(insertion_m="0.01"),
    "solve-bool.json": solve(insertion_m=True),
    "solve-nan.json": solve(insertion_m=math.nan),
    "solve-huge.json": solve(curvature_per_m=1e300),
    "solve-int.json": solve().replace("0.01", "1" + "0" * 400),
    "solve-force.json": solve(force_N=[0.0, math.inf, 0.0]),
    "solve-short.json": solve(force_N=[0.0, 0.05]),
    "solve-gram.json": solve(force_N=[0.0, 51.0, 0.0]),
    "solve-key.json": solve(insertion_mm=10.0),
    "solve-near.json": solve(curvature_per_M=10.0),
    "solve-model.json": solve(model="rod"),
    "solve-catheter.json": solve(catheter="livewir"),
    "solve-path.json": solve(catheter="nowhere.toml"),
    "solve-frame.json": solve(force_frame="world"),
    "solve-station.json": solve(stations_m=[30.0]),
    "solve-tendon.json": solve(tendon_tension_N=-1.0),
    "solve-none.json": json.dumps({key: SOLVE[key] for key in SOLVE if key != "force_N"}),
    "solve-twice.json": json.dumps(SOLVE)[:-1] + ', "insertion_m": 0.02}',
    "solve-inside.json": solve(insertion_m=-0.4),
    "estimate-far.json": json.dumps(
        ESTIMATE | {"sensors": [{"offset_m": 0.0, "position_m": [0.9, 0.0, 0.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}]}
    ),
    "estimate-unit.json": json.dumps(
        ESTIMATE | {"sensors": [{"offset_m": 0.0, "position_m": [0.06, 0.0, 0.0], "quaternion_wxyz": [1.0, 1.0, 0.0, 0.0]}]}
    ),
    "estimate-mm.json": json.dumps(
        ESTIMATE | {"sensors": [{"offset_m": 0.0, "position_m": [60.0, 0.0, 0.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}]}
    ),
    "estimate-none.json": json.dumps(ESTIMATE | {"sensors": []}),
    "estimate-case.json": json.dumps(ESTIMATE | {"case": 7}),
    # calibrate
    "shapes-text.csv": SHAPES_HEAD + SHAPES_ROW + SHAPES_ROW.replace("0.1145", "far"),
    "shapes-nan.csv": SHAPES_HEAD + SHAPES_ROW.replace("0.1145", "nan"),
    "shapes-gap.csv": SHAPES_HEAD + SHAPES_ROW.replace("0.1145", ""),
    "shapes-short.csv": SHAPES_HEAD + "1,0.0485\n",
    "shapes-head.csv": SHAPES_HEAD.replace("x_m", "x_mm") + SHAPES_ROW,
    "shapes-mm.csv": SHAPES_HEAD + SHAPES_ROW.replace("0.1145", "114.5"),
    "shapes-only-head.csv": SHAPES_HEAD,
    "shapes-binary.csv": b"\xff\xfe\x00" * 50,
    "shapes-key.json": json.dumps({"recordings": [SHAPE | {"colour": 1}]}),
    # diagnose
    "text.csv": table(cell="broken"),
    "units.csv": table(cell="0.01 m"),
    "nan.csv": table(cell="nan", every=True),
    "huge.csv": table(cell="1e308", every=True),
    "head.csv": "t,force,position\n",
    "short.csv": "t,force,position\n0,0,0\n1,1,1\n",
    "other-column.csv": table(head="t,force,place"),
    "twice.csv": table(head="t,force,force"),
    "pipes.csv": table().replace(",", "|"),
    "unit-row.csv": table(head="t,force,position\ns,N,m"),
    "utf-16.csv": table().encode("utf-16"),
    "packed.csv": gzip.compress(table().encode()),
    "ragged.csv": "t,force,position\n0,0\n1,1,1,1\n",
    "backwards.csv": "t,force,position\n" + "\n".join(f"{5 - 0.01 * i},0.{i % 7},0.{i % 9}" for i in range(300)) + "\n",
    "cut.parquet": b"PAR1" + bytes(20),
    "good.xyz": table(),
    "nominal-key.toml": NOMINAL.replace("subsystem", "subsytem"),
    "nominal-kind.toml": NOMINAL.replace('kind = "axis"', 'kind = "axle"'),
    "nominal-text.toml": NOMINAL.replace('time = "t"', "time = 3"),
    "nominal-unit.toml": NOMINAL.replace('unit = "N"', 'unit = "newtons"'),
    "nominal-parameter-unit.toml": NOMINAL + '[parameters]\nmass = {value = 1.0, unit = "kilogramme"}\n',
    "nominal-offer-unit.toml": NOMINAL + '[[offer]]\nid = "backlash"\nparameter = "a"\nhigh = 1.0\nunit = "Meter"\n',
    "nominal-empty.toml": "",
    # rig files
    "rig-per-mm.toml": rig("steps_per_unit = 320000.0", "steps_per_unit = 320.0"),
    "rig-slow.toml": rig("rate_hz = 40.0", "rate_hz = 5.0"),
    "rig-loop.toml": rig("loop_hz = 1000", "loop_hz = 100"),
    "rig-text.toml": rig("rate_hz = 40.0", 'rate_hz = "40"'),
    "rig-case.toml": rig("rate_hz = 40.0", "rate_Hz = 40.0"),
    "rig-kHz.toml": rig("loop_hz = 1000 ", "loop_hz = 1 "),
    "rig-ms.toml": rig("latency_s = 0.025", "latency_s = 25.0"),
    "rig-mm.toml": rig("min_unit = -0.050", "min_unit = -50.0"),
    "rig-degrees.toml": rig("min_unit = -7.0", "min_unit = -400.0"),
    "rig-speed.toml": rig("max_speed_unit_per_s = 0.05", "max_speed_unit_per_s = 50.0"),
    "rig-nan.toml": rig("over_force_N = 0.5", "over_force_N = nan"),
    "rig-force.toml": rig("over_force_N = 0.5", "over_force_N = 500.0"),
    "rig-flat.toml": rig("[-45.0, 0.0, 0.0, 45.0]", "[0.0, 0.0, 0.0, 0.0]"),
    "rig-catheter.toml": rig('name = "blazer_prime_xp"', 'name = "blazer"'),
    "rig-name.toml": rig('name = "simulated"', 'name = "My Rig"'),
    "rig-bool.toml": rig("retract_stopped = true", "retract_stopped = 1"),
    "rig-twice.toml": rig('name = "simulated"', 'name = "simulated"\nname = "again"'),
    "rig-unit.toml": rig("[0.5, 0.5, 0.5, 0.5]", "[1.0, 1.0, 0.0, 0.0]"),
    "rig-tracker-mm.toml": rig("position_noise_m = 0.00029", "position_noise_m = 0.29"),
    "rig-retract.toml": rig("retract_distance_m = 0.010", "retract_distance_m = 0.00001"),
    "rig-retract-speed.toml": rig("retract_speed_m_per_s = 0.03", "retract_speed_m_per_s = 0.00003"),
    "rig-tip-speed.toml": rig("max_tip_speed_m_per_s = 0.25", "max_tip_speed_m_per_s = 0.00025"),
    "rig-host.toml": rig("host_lost_after_s = 2.0", "host_lost_after_s = 0.002"),
    "rig-least.toml": rig("over_force_N = 0.5", "over_force_N = 0.0005"),
    "rig-slow-stage.toml": rig("max_speed_unit_per_s = 0.05", "max_speed_unit_per_s = 0.00087"),
    "rig-sign.toml": rig("min_unit = -0.050", "min_unit = 0.050"),
    "rig-travel.toml": rig("min_unit = -0.050", "min_unit = -0.00005").replace("max_unit = 0.110", "max_unit = 0.00011", 1),
    "rig-counts.toml": rig("encoder_counts_per_step = 1.0", "encoder_counts_per_step = 1000.0"),
    "rig-digits.toml": rig("loop_hz = 1000 ", "loop_hz = 1" + "0" * 5000),
    "rig-length.toml": rig("distal_length_m = 0.110", "distal_length_m = 110.0"),
    "rig-no-port.toml": rig('port = "pty:board"', 'port = ""'),
    "rig-no-tracker.toml": rig('port = "pty:aurora"', 'port = " "'),
    "rig-server.toml": rig('kind = "aurora"', 'kind = "openigtlink"'),
    "rig-server-port.toml": rig('kind = "aurora"', 'kind = "openigtlink"').replace('"pty:aurora"', '"127.0.0.1:99999"'),
    "rig-address.toml": rig('address = "127.0.0.1"', 'address = "the force box"'),
    "rig-url.toml": rig('address = "127.0.0.1"', 'address = "http://192.168.1.1/"'),
    "rig-same-tool.toml": rig('tip_handle = "0A"', 'tip_handle = "0B"'),
    "rig-no-tool.toml": rig('tip_handle = "0A"', 'tip_handle = ""'),
    "rig-tool.toml": rig('tip_handle = "0A"', 'tip_handle = "0a"'),
    "rig-definition.toml": rig('tip_definition = ""', 'tip_definition = "absent.rom"'),
    # catheter files
    "catheter-mm.toml": catheter("distal_length_m = 0.110", "distal_length_m = 110.0"),
    "catheter-french.toml": catheter("diameter_m = 0.00233", "diameter_m = 7.0"),
    "catheter-stiff.toml": catheter("EI1_N_m2 = 0.1902e-3", "EI1_N_m2 = 190.2"),
    "catheter-offset.toml": catheter("pull_wire_offset_m = 0.0007", "pull_wire_offset_m = 0.007"),
    "catheter-nan.toml": catheter("EI1_N_m2 = 0.1902e-3", "EI1_N_m2 = nan"),
    "catheter-text.toml": catheter("diameter_m = 0.00233", 'diameter_m = "7 F"'),
    "catheter-key.toml": catheter("diameter_m", "diametre_m"),
    "catheter-arcs.toml": catheter("distal_arcs_m = [0.011,", "distal_arcs_m = [11.0,"),
    # protocols and scripts
    "protocol-key.toml": PROTOCOL + "[tolerence]\nforce_N = 0.1\n",
    "protocol-step.toml": PROTOCOL.replace('"goto"', '"fly"'),
    "protocol-mm.toml": PROTOCOL.replace("[0.0, -0.0107, 0.020]", "[0.0, -10.7, 20.0]"),
    "protocol-none.toml": 'name = "none"\nsteps = []\n',
    "protocol-force.toml": PROTOCOL.replace("[[steps]]", "force_N = 20.0\n[[steps]]"),
    "protocol-text.toml": PROTOCOL.replace("[0.0, -0.0107, 0.020]", '["0", "-0.0107", "0.02"]'),
    "protocol-away.toml": PROTOCOL.replace("0.020]", "0.5]"),
    "protocol-normal.toml": 'name = "n"\nnormal = [0.0, 0.0, 3.0]\n' + PROTOCOL.partition("\n")[2],
    "script-key.toml": SCRIPT.replace("says", "sais"),
    "script-row.toml": SCRIPT.replace("[1.0, 0.0, -0.0107, 0.021]", "[1.0, 0.0]"),
    "script-jump.toml": SCRIPT.replace("[1.0, 0.0, -0.0107, 0.021]", "[0.001, 0.0, -0.0107, 0.03]"),
    "script-rig.toml": SCRIPT.replace('rig = "simulated"', 'rig = "other"'),
    # other files
    "plan-key.json": json.dumps({**PLAN, "goal": 1}),
    "plan-mm.json": json.dumps({**PLAN, "goal_m": [0.0, -10.7, 20.0]}),
    "plan-short.json": json.dumps({**PLAN, "goal_m": [0.0, 0.02]}),
    "plan-degrees.json": json.dumps({**PLAN, "start": {**PLAN["start"], "roll_rad": 360.0}}),  # type: ignore[dict-item]
    "plan-kind.json": json.dumps({**PLAN, "obstacles": [{"kind": "sphere"}]}),
    "plan-shape.json": json.dumps({**PLAN, "obstacles": [{"type": "cube"}]}),
    "verdict.json": '{"verdict": 3}',
    "calibration.toml": "[transmission]\ncolour = 1\n",
}

REQUEST = (
    "missing.json",
    "folder",
    "empty",
    "binary",
    "cut.json",
    "list.json",
    "deep.json",
    "number.json",
    "utf-16",
    "/dev/zero",
)
TOML = ("missing.toml", "folder", "empty", "binary", "cut.toml", "other.toml", "deep.toml", "utf-16", "packed", "/dev/zero")
RECORDING = ("missing.mcap", "folder", "empty", "binary", "cut.mcap", "archive", "/dev/zero", "good.csv")
# Places where nothing can be written: a folder below a file, and a file of the kernel's.
UNWRITABLE = ("rig.toml/below", "/dev/null/runs", "/proc/runs")
NO_SEED = ("-1", "1.5", "one", "99999999999999", "nan")

Case = tuple[tuple[str, ...], str]


def of_files() -> list[Case]:
    """Every argument that is a file, with files that it cannot be."""
    takers: list[tuple[tuple[str, ...], tuple[str, ...]]] = [
        (("solve",), REQUEST),
        (("estimate",), REQUEST),
        (("plan",), REQUEST),
        (("calibrate", "--catheter", "thermocool_sf"), REQUEST),
        (("rig", "check"), TOML),
        (("run", "--dry-run"), TOML),
        (("experiment",), TOML),
        (("play",), RECORDING),
        (("export",), RECORDING),
        (("characterize", "--recording"), RECORDING[:-1]),
        (("demo", "--rig"), TOML),
        (("tune", "--check", "--calibration"), TOML),
        (("view", "--rig"), TOML[:3]),
        (("jog", "roll", "1deg", "--rig"), TOML[:3]),
        (("stop", "--rig"), TOML[:3]),
        (("home", "roll", "--yes", "--rig"), TOML[:3]),
        (("status", "--rig"), TOML[:3]),
        (("check-device", "board", "--rig"), TOML[:3]),
        (("diagnose", "good.csv", "--nominal"), TOML),
        (("diagnose", "--nominal", "nominal.toml"), ("missing.csv", "empty", "binary", "good.xyz", "cut.parquet")),
    ]
    return [((*words, file), Path(file).name) for words, files in takers for file in files]


def of_options() -> list[Case]:
    """Options that several commands share."""
    cases: list[Case] = []
    for command in ("demo", "bench", "faults", "soak", "prove", "tune", "characterize"):
        cases += [((command, "--seed", seed), "--seed") for seed in NO_SEED]
    cases += [((*words, "--seed", "-1"), "--seed") for words in (("run", "protocol.toml"), ("experiment", "script.toml"))]
    for words in (
        ("demo",),
        ("characterize",),
        ("reproduce", "control"),
        ("prove",),
        ("run", "protocol.toml", "--yes"),
        ("view", "--simulated"),
    ):
        cases += [((*words, "--out", place), "--out") for place in UNWRITABLE]
    cases += [(("diagnose", "good.csv", "--nominal", "nominal.toml", "--out", place), "--out") for place in UNWRITABLE]
    cases += [(("calibrate", "shapes.json", "--catheter", "thermocool_sf", "--out", place), "--out") for place in UNWRITABLE]
    for command in ("faults", "prove", "tune", "warm"):
        cases += [((command, "--jobs", jobs), "--jobs") for jobs in ("-1", "two", "1e9")]
    for command in ("demo", "faults", "soak", "characterize"):
        cases.append(((command, "--board", "arduino"), "--board"))
    cases += [
        ((command, "--colour"), "--colour")
        for command in command_line.COMMANDS
        if command not in command_line.NEGATIVE_VALUES
    ]
    return cases


# The rest, one line each.
CASES: list[Case] = [
    (("dmeo",), "did you mean demo?"),
    (("tracker",), "command"),
    (("--colour",), "--colour"),
    # numbers
    (("demo", "--hold", "nan"), "--hold"),
    (("demo", "--hold", "0"), "--hold"),
    (("demo", "--hold", "1e9"), "--hold"),
    (("demo", "--force", "nan"), "--force"),
    (("demo", "--force", "-0.2"), "--force"),
    (("demo", "--force", "200"), "--force"),
    (("demo", "--force", "0.2N"), "--force"),
    (("demo", "--force-source", "guess"), "--force-source"),
    (("demo", "--effect", "backlsh@insertion"), "backlsh"),
    (("demo", "--effect", "backlash@insertion:width=1"), "width"),
    (("demo", "--effect", ""), "--effect"),
    (("demo", "--fast", "--wall-clock"), "--fast"),
    (("characterize", "--board-port", "/dev/null"), "--real"),
    (("characterize", "--tracker-port", "/dev/null"), "--real"),
    (("soak", "--minutes", "nan"), "--minutes"),
    (("soak", "--minutes", "-5"), "--minutes"),
    (("faults", "--runs", "0"), "--runs"),
    (("faults", "--fault", "gremlins"), "--fault"),
    (("latency-check", "--seconds", "nan"), "--seconds"),
    (("latency-check", "--seconds", "-1"), "--seconds"),
    (("latency-check", "--hz", "1e6"), "--hz"),
    (("latency-check", "--hz", "1000000"), "--hz"),
    (("latency-check", "--with", "nobody"), "--with"),
    (("control-study", "--seeds", "1,x"), "--seeds"),
    (("control-study", "--seeds", "-1"), "--seeds"),
    (("control-study", "--seconds", "inf"), "--seconds"),
    (("control-study", "--only", "colour"), "--only"),
    (("tune", "--evaluations", "1"), "--evaluations"),
    (("tune", "--gains", "colour"), "colour"),
    (("characterize", "--repeats", "0"), "--repeats"),
    (("characterize", "--real"), "--yes"),
    (("characterize", "--yes"), "--real"),
    (("characterize", "--real", "--recording", "cut.mcap"), "--real"),
    (("prove", "--cases", "0"), "--cases"),
    (("prove", "--world", "flat"), "--world"),
    (("prove", "--resume", "folder"), "--resume"),
    (("prove", "--finder", "missing-program"), "missing-program"),
    (("prove", "--calibration", "missing.json"), "missing.json"),
    (("prove", "--calibration", "empty"), "empty"),
    (("bench", "--only", "colour"), "colour"),
    (("warm", "--only", "colour"), "--only"),
    (("reproduce", "everything"), "part"),
    (("check-device", "camera"), "device"),
    (("check-device", "board", "--seconds", "nan"), "--seconds"),
    (("check-device", "force", "--udp-port", "99999"), "--udp-port"),
    (("home", "elbow", "--rig", "rig.toml", "--yes"), "axis"),
    (("home", "roll", "--rig", "rig.toml", "--yes"), "home_end"),
    (("home",), "axis"),
    (("stop",), "--rig"),
    (("flash",), "--port"),
    (("flash", "--port", "/dev/null", "--dry-run", "--mcu", "z80"), "z80"),
    (("flash", "--port", "", "--dry-run"), "--port"),
    (("install-services", "--root", "rig.toml"), "--root"),
    (("jog", "", "2mm"), "axis"),
    (("goto", "nan,nan,nan"), "place"),
    (("touch", "0,0,25mm", "--normal", "nan,0,1"), "--normal"),
    (("touch", "0,0,25mm", "--force", "nan"), "--force"),
    (("touch", "0,0,25mm", "--force", "0"), "--force"),
    (("force", "inf"), "newton"),
    (("mark", "a\nb"), "note"),
    (("arm", "--rig", "rig.toml", "--rig", "protocol.toml"), "protocol.toml"),
    (("check-device", "", "--rig", "rig.toml"), "device"),
    (("export", "folder", "--to", "csv"), "folder"),
    (("run", "protocol.toml", "--simulated", "--seed", "1", "--seed", "-2"), "--seed"),
    (("run", "--dry-run", "rig.toml"), "rig.toml"),
    (("plan", "rig.toml"), "rig.toml"),
    (("plan", "solve.json"), "goal_m"),
    (("solve", "shapes.json"), "shapes.json"),
    (("experiment", "protocol.toml"), "protocol.toml"),
    (("keys", "issue", "../x", "--role", "reader", "--directory", "folder"), "../x"),
    (("flash", "--port", "/dev/null", "--dry-run", "--image", "missing.elf"), "--image"),
    (("flash", "--port", "/dev/null", "--dry-run", "--image", "rig.toml"), "--image"),
    (("flash", "--port", "/dev/null", "--dry-run", "--image", "archive", "--baud", "-5"), "--image"),
    (("bridge",), "igtl or ros2"),
    (("bridge", "ros1"), "igtl or ros2"),
    (("rig",), "check"),
    (("rig", "show"), "check"),
    (("keys", "init", "--directory", "folder/new", "--laboratory", ""), "--laboratory"),
    (("install-services", "--root", "folder", "--cpu", "9999"), "--cpu"),
    (("view", "--port", "80"), "--port"),
    (("view", "--port", "{port in use}"), "--port"),
    (("play", "cut.mcap", "--port", "{port in use}"), "--port"),
    (("play", "cut.mcap", "--speed", "nan"), "--speed"),
    (("play", "cut.mcap", "--speed", "0"), "--speed"),
    (("play", "cut.mcap", "--unpack-limit", "0"), "--unpack-limit"),
    (("export", "cut.mcap", "--to", "xlsx"), "--to"),
    # driving: refused before a connection is made
    (("jog", "elbow", "1mm"), "axis"),
    (("jog", "insertion", "far"), "travel"),
    (("jog", "insertion", "5deg"), "travel"),
    (("jog", "roll", "5mm"), "travel"),
    (("jog", "insertion", "nan"), "travel"),
    (("jog", "insertion"), "travel"),
    (("jog", "0,0,0", "1mm"), "axis"),
    (("jog", "e1", "1mm", "--speed", "quick"), "--speed"),
    (("jog", "insertion", "30mm"), "travel"),
    (("jog", "insertion", "0mm"), "travel"),
    (("jog", "roll", "90"), "travel"),
    (("jog", "e1", "1mm", "--speed", "-5mm"), "--speed"),
    (("jog", "e1", "1mm", "--speed", "0mm"), "--speed"),
    (("goto", "0,-10.7,20"), "mm need their unit"),
    (("goto", "0,0,20mm", "--tolerance", "-1mm"), "--tolerance"),
    (("goto", "0,0,20mm", "--within", "0s"), "--within"),
    (("touch", "0,0,25mm", "--force", "-0.2"), "--force"),
    (("touch", "0,0,25mm", "--force", "20"), "--force"),
    (("touch", "0,0,25mm", "--froce", "0.2"), "did you mean --force?"),
    (("touch", "0,0,25mm", "--for", "-5s"), "--for"),
    (("touch", "0,0,25mm", "--within", "1e9s"), "--within"),
    (("force", "20"), "newton"),
    (("mark", "\x1b[2Jgone"), "note"),
    (("goto", "0,1"), "place"),
    (("goto", "0,1,far"), "place"),
    (("goto", "0,0,1e999"), "place"),
    (("goto", "0,0,20mm", "--tolerance", "5deg"), "--tolerance"),
    (("goto", "0,0,20mm", "--within", "soon"), "--within"),
    (("touch", "0,0,25mm", "--normal", "0,0,0"), "--normal"),
    (("touch", "0,0,25mm", "--force", "strong"), "--force"),
    (("touch", "0,0,25mm", "--for", "5mm"), "--for"),
    (("force", "hard"), "newton"),
    (("force", "5mm"), "newton"),
    (("mark", ""), "note"),
    (("mark", "x" * 501), "note"),
    (("arm", "--name", "Ann Lee"), "Ann Lee"),
    (("arm", "--endpoint", "tls/rig:7448"), "keys"),
    (("arm", "--keys", "folder"), "endpoint"),
    (("status", "--endpoint", "tls/no-such-host.invalid:7448", "--keys", "folder"), "folder"),
    (("stop", "--rig", "rig.toml", "--endpoint", "tls/rig:7448"), "keys"),
    (("run", "protocol.toml"), "--yes"),
    (("run", "protocol.toml", "--dry-run", "--resume", "missing.json"), "missing.json"),
    (("run", "protocol.toml", "--dry-run", "--resume", "list.json"), "list.json"),
    (("run", "protocol.toml", "--simulated", "--effect", "colour@knob"), "colour"),
    (("experiment", "script.toml", "--go", "--simulated"), "--go"),
    # keys
    (("keys", "issue", "ann", "--role", "reader", "--directory", "nowhere"), "nowhere"),
    (("keys", "issue", "ann", "--role", "king", "--directory", "folder"), "king"),
    (("keys", "show", "--directory", "nowhere"), "nowhere"),
    (("keys", "init", "--directory", "rig.toml/below"), "rig.toml/below"),
    (("keys", "init", "--directory", "folder/new", "--passphrase-file", "missing.txt"), "--passphrase-file"),
    (("keys", "init", "--directory", "folder/new", "--passphrase-file", "empty"), "--passphrase-file"),
    (("keys", "lend"), "lend"),
    # requests
    (("solve", "solve-mm.json"), "50 mm is 0.05"),
    (("solve", "solve-text.json"), "insertion_m"),
    (("solve", "solve-bool.json"), "insertion_m"),
    (("solve", "solve-nan.json"), "insertion_m"),
    (("solve", "solve-huge.json"), "curvature_per_m"),
    (("solve", "solve-int.json"), "insertion_m"),
    (("solve", "solve-force.json"), "force_N.1"),
    (("solve", "solve-short.json"), "force_N"),
    (("solve", "solve-gram.json"), "51 mN is 0.051"),
    (("solve", "solve-key.json"), "did you mean insertion_m?"),
    (("solve", "solve-near.json"), "did you mean curvature_per_m?"),
    (("solve", "solve-model.json"), "model"),
    (("solve", "solve-catheter.json"), "livewir"),
    (("solve", "solve-path.json"), "nowhere.toml"),
    (("solve", "solve-frame.json"), "force_frame"),
    (("solve", "solve-station.json"), "30 mm is 0.03"),
    (("solve", "solve-tendon.json"), "tendon_tension_N"),
    (("solve", "solve-none.json"), "force_N"),
    (("solve", "solve-inside.json"), "insertion_m"),
    (("solve", "solve.json", "--plot", "picture.svg"), "--plot"),
    (("solve", "solve.json", "--plot", "nowhere/picture.png"), "--plot"),
    (("solve",), "request"),
    (("solve", "solve.json", "more"), "more"),
    (("estimate", "estimate-far.json"), "sensors.0.position_m"),
    (("estimate", "estimate-unit.json"), "quaternion_wxyz"),
    (("estimate", "estimate-mm.json"), "60 mm is 0.06"),
    (("estimate", "estimate-none.json"), "sensors"),
    (("estimate", "estimate-case.json"), "case"),
    (("plan", "plan-key.json"), "goal"),
    (("plan", "plan-mm.json"), "-10.7 mm is -0.0107"),
    (("plan", "plan-short.json"), "goal_m"),
    (("plan", "plan-degrees.json"), "360 degrees is 6.28319"),
    (("plan", "plan-kind.json"), "'type'"),
    (("plan", "plan-shape.json"), "'sphere', 'capsule', 'mesh'"),
    (("solve", "solve-twice.json"), "insertion_m"),
    # calibrate
    *(
        (("calibrate", f"shapes-{name}", "--catheter", "thermocool_sf"), text)
        for name, text in (
            ("text.csv", "line 3"),
            ("nan.csv", "line 2"),
            ("gap.csv", "line 2"),
            ("short.csv", "line 2"),
            ("head.csv", "x_mm"),
            ("mm.csv", "114.5 mm is 0.1145"),
            ("only-head.csv", "recordings"),
            ("binary.csv", "shapes-binary.csv"),
            ("key.json", "colour"),
        )
    ),
    (("calibrate", "shapes.json", "--catheter", "nobody"), "catheter"),
    (("calibrate", "shapes.json"), "--catheter"),
    (("calibrate", "shapes.json", "--catheter", "thermocool_sf", "--fit", "colour"), "fit"),
    (("calibrate", "shapes.json", "--catheter", "thermocool_sf", "--name", "a/b"), "--name"),
    (("calibrate", "shapes.json", "--catheter", "cut.toml"), "catheter"),
    # diagnose
    *(
        (("diagnose", f"{name}.csv", "--nominal", "nominal.toml"), text)
        for name, text in (
            ("text", "line 202"),
            ("units", "line 202"),
            ("head", "head.csv"),
            ("short", "short.csv"),
            ("other-column", "position"),
            ("twice", "force"),
            ("ragged", "ragged.csv"),
            ("pipes", "pipes.csv"),
            ("unit-row", "delete a row of units"),
            ("utf-16", "text in UTF-16"),
            ("packed", "data packed by gzip"),
            ("backwards", "t"),
        )
    ),
    (("diagnose", "good.csv"), "--nominal"),
    (("diagnose", "good.csv", "folder/../good.csv", "--nominal", "nominal.toml"), "good.csv twice"),
    (("diagnose", "good.csv", "--live"), "--live"),
    *(
        (("diagnose", "--live", *words), f"{words[0]}: found")
        for words in (
            ("--nominal", "nominal.toml"),
            ("--out", "folder"),
            ("--data", "folder"),
            ("--without", "backlash"),
            ("--effect", "backlash@cable"),
            ("--export", "model.py"),
            ("--time-budget", "0"),
            ("--trust",),
        )
    ),
    (("diagnose", "good.csv", "--nominal", "nominal.toml", "--rig", "rig.toml"), "--rig"),
    (("diagnose", "good.csv", "--nominal", "nominal.toml", "--without", "backlsh"), "backlsh"),
    (("diagnose", "good.csv", "--nominal", "nominal.toml", "--time-budget", "nan"), "--time-budget"),
    (("diagnose", "good.csv", "--nominal", "nominal.toml", "--time-budget", "-1"), "--time-budget"),
    (("diagnose", "good.csv", "--nominal", "nominal.toml", "--export", "model.txt"), "export"),
    (("diagnose", "good.csv", "--nominal", "nominal.toml", "--export", "nowhere/model.py"), "nowhere/model.py"),
    (("diagnose", "good.csv", "--nominal", "nominal.toml", "--effect", "backlash"), "effect"),
    (("diagnose", "good.csv", "--nominal", "nominal.toml", "--data", "nowhere"), "nowhere"),
    (("diagnose", "good.csv", "--nominal", "nominal-key.toml"), "did you mean subsystem?"),
    (("diagnose", "good.csv", "--nominal", "nominal-kind.toml"), "kind"),
    (("diagnose", "good.csv", "--nominal", "nominal-unit.toml"), "newtons is N"),
    (("diagnose", "good.csv", "--nominal", "nominal-parameter-unit.toml"), 'parameters.mass.unit: found "kilogramme"'),
    (("diagnose", "good.csv", "--nominal", "nominal-offer-unit.toml"), "Meter is m"),
    (("diagnose", "good.csv", "--nominal", "nominal-text.toml"), "time"),
    (("diagnose", "good.csv", "--nominal", "no_such_model"), "no_such_model"),
    (("diagnose", "--nominal", "nominal.toml"), "recording"),
    # rig files: what the check says is what the start says
    *(
        (words, text)
        for name, text in (
            ("per-mm", "320 steps/mm is 320000"),
            ("slow", "safety.hold_after_s"),
            ("loop", "board.setpoint_expiry_s"),
            ("text", "tracker.rate_hz"),
            ("case", "did you mean rate_hz?"),
            ("kHz", "1 kHz is 1000"),
            ("ms", "25 ms is 0.025"),
            ("mm", "-50 mm is -0.05"),
            ("degrees", "-400 degrees is -6.98132"),
            ("speed", "50 mm/s is 0.05"),
            ("nan", "safety.over_force_N"),
            ("force", "500 mN is 0.5"),
            ("flat", "curvature_per_m"),
            ("catheter", "blazer"),
            ("name", "My Rig"),
            ("bool", "safety.retract_stopped"),
            ("twice", "rig-twice.toml"),
            ("unit", "base_from_tracker_wxyz"),
            ("tracker-mm", "0.29 mm is 0.00029"),
            ("length", "110 mm is 0.11"),
            ("digits", "rig-digits.toml"),
            ("retract", "safety.retract_distance_m"),
            ("retract-speed", "safety.retract_speed_m_per_s"),
            ("tip-speed", "safety.max_tip_speed_m_per_s"),
            ("host", "safety.host_lost_after_s"),
            ("least", "safety.over_force_N"),
            ("slow-stage", "stages.insertion.max_speed_unit_per_s"),
            ("sign", "stages.insertion"),
            ("travel", "stages.insertion"),
            ("counts", "encoder_counts_per_step"),
            ("no-port", "board.port"),
            ("no-tracker", "tracker: found port"),
            ("server", "wanted port: HOST:PORT"),
            ("server-port", "127.0.0.1:99999"),
            ("address", "the force box"),
            ("url", "http://192.168.1.1/"),
            ("same-tool", "two different tools"),
            ("no-tool", "two different tools"),
            ("tool", "tip_handle = 0a"),
            ("definition", 'tracker.tip_definition: found "absent.rom"'),
        )
        for words in (("rig", "check", f"rig-{name}.toml"), ("demo", "--rig", f"rig-{name}.toml"))
    ),
    # catheter files
    *(
        (("calibrate", "shapes.json", "--catheter", f"catheter-{name}.toml"), text)
        for name, text in (
            ("mm", "110 mm is 0.11"),
            ("french", "7 mm is 0.007"),
            ("stiff", "190.2 N mm2 is 0.0001902"),
            ("offset", "at most half of diameter_m"),
            ("nan", "cosserat.EI1_N_m2"),
            ("text", "diameter_m"),
            ("key", "did you mean diameter_m?"),
            ("arcs", "distal_arcs_m"),
        )
    ),
    # protocols and scripts
    (("run", "--dry-run", "protocol-key.toml"), "did you mean tolerance?"),
    (("run", "--dry-run", "protocol-step.toml"), "fly"),
    (("run", "--dry-run", "protocol-mm.toml"), "steps.1"),
    (("run", "--dry-run", "protocol-none.toml"), "steps"),
    (("run", "--dry-run", "protocol-force.toml"), "force_N"),
    (("run", "--dry-run", "protocol-text.toml"), "point_m"),
    (("run", "--dry-run", "protocol-away.toml"), "steps.1"),
    (("run", "--dry-run", "protocol-normal.toml"), "normal"),
    (("experiment", "script-key.toml"), "did you mean says?"),
    (("experiment", "script-row.toml"), "rows.1"),
    (("experiment", "script-jump.toml"), "rows"),
    (("experiment", "script-rig.toml"), "rig"),
    # other files
    (("play", "cut.mcap", "--diagnosis", "verdict.json"), "cut.mcap"),
    (("tune", "--check", "--calibration", "calibration.toml"), "colour"),
]
ALL = [*of_files(), *of_options(), *CASES]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all the files."""
    place = tmp_path_factory.mktemp("bad")
    for name, content in FILES.items():
        (place / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    (place / "folder").mkdir()
    return place


@pytest.fixture(scope="module")
def port_in_use() -> str:
    """A port of this machine that a listener has."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield str(listener.getsockname()[1])


def answer(words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> int:
    """Run the program with `words`. Returns its exit status."""
    monkeypatch.setattr(sys, "argv", ["seldinger", *words])
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    return int(ended.value.code or 0)


def test_there_are_two_hundred_and_every_command_is_among_them() -> None:
    assert len(set(ALL)) == len(ALL) >= 200
    assert {words[0] for words, _ in ALL} >= set(command_line.COMMANDS)


@pytest.mark.parametrize(("words", "named"), ALL, ids=[" ".join(words)[:70] for words, _ in ALL])
def test_a_bad_input_is_one_line(
    words: tuple[str, ...],
    named: str,
    folder: Path,
    port_in_use: str,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_STATE_HOME", str(folder))
    monkeypatch.delenv("SELDINGER_DATA", raising=False)
    before = sorted(folder.rglob("*"))
    status = answer(tuple(word.replace("{port in use}", port_in_use) for word in words), monkeypatch)
    said = capfd.readouterr()
    # Kernels may be compiled, and a slow machine draws a line of progress; `rig check` prints a line for each mistake.
    lines = [line for line in said.err.splitlines() if not line.startswith("[") and line != compile_notice.WORDS]
    if words[:2] == ("rig", "check"):
        lines = [line for line in lines if named in line][:1]
    assert status == 2, said.err
    assert len(lines) == 1 and lines[0].startswith("seldinger: ") and not said.out, said
    assert named in lines[0] and "Traceback" not in lines[0], lines
    assert len(lines[0]) < 700
    assert sorted(folder.rglob("*")) == before
