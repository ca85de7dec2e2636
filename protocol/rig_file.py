"""The one rig file: what the rig is, its limits and gains. Unknown keys and values out of bounds are refused."""

from __future__ import annotations

import ipaddress
import math
import re
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from protocol import board_pins, loop_margin
from protocol.catheter import load_catheter
from protocol.errors import InputError
from protocol.local_paths import LocalPaths, local_paths
from protocol.requests import first_of, known_keys, unknown_key, wanted_of
from protocol.text_files import read_toml
from protocol.topics import check_name
from protocol.unit_slips import hint_of
from protocol.usual_values import NET_FT, RIG, unusual, warn_of
from protocol.zenoh_access import Network, check_network_endpoint

AXES = ("insertion", "roll", "knob")
SIMULATED_RIG = Path(__file__).parent / "rigs" / "simulated.toml"

# Bounds that no rig file can widen (a safety limit cannot be configured away).
HARD_MAX_FORCE_N = 0.5
HARD_STOP_AFTER_S = 0.150
# Measured and tabulated lengths of a distal shaft differ by less than this.
DISTAL_TOLERANCE_M = 0.005


class _Section(BaseModel):
    # Strict: a text is not a number, and 1 is not true. Lists of TOML become tuples.
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


Positive = Annotated[float, Field(gt=0)]
Quaternion = Annotated[tuple[float, float, float, float], Field(strict=False)]
# Of points in the rig's frames: further away is a mistaken unit.
Coordinate = Annotated[float, Field(ge=-3.0, le=3.0)]
Vector3 = Annotated[tuple[Coordinate, Coordinate, Coordinate], Field(strict=False)]


# Of a device's driver (docs/devices.md), and the keys of a plug-in.
Kind = Annotated[str, Field(pattern=r"^[a-z0-9_]{1,40}$")]
Options = dict[str, str | bool | int | float]


class StageSection(_Section):
    """One stepper axis; insertion and the rotating ones have bounds of their own."""

    steps_per_unit: Positive
    encoder_counts_per_step: Annotated[float, Field(ge=0.02, le=200)] = 1.0
    max_speed_unit_per_s: Positive
    max_accel_unit_per_s2: Positive
    min_unit: float
    max_unit: float
    home_end: Literal["", "min", "max"] = ""
    home_unit: float = 0.0
    home_speed_unit_per_s: Annotated[float, Field(ge=0)] = 0.0

    @model_validator(mode="after")
    def _ordered(self) -> StageSection:
        if self.min_unit >= self.max_unit:
            raise ValueError("min_unit below max_unit")
        if not self.home_end and not self.min_unit <= 0.0 <= self.max_unit:
            raise ValueError(
                "min_unit at most 0 and max_unit at least 0, for an axis that counts from where it is switched on"
            )
        if self.max_speed_unit_per_s * self.steps_per_unit > 20_000:
            raise ValueError("at most 20000 steps/s (max_speed_unit_per_s * steps_per_unit), the board's step timer")
        if self.max_speed_unit_per_s / self.max_accel_unit_per_s2 > 0.045:
            raise ValueError("a stop from full speed within 0.045 s (max_speed_unit_per_s / max_accel_unit_per_s2)")
        if self.home_end and not 0 < self.home_speed_unit_per_s <= 0.2 * self.max_speed_unit_per_s:
            raise ValueError("home_speed_unit_per_s above 0 and at most a fifth of max_speed_unit_per_s, for home_end")
        return self


class InsertionStage(StageSection):
    """The linear stage; `unit` is m. A step of 0.1 um to 0.1 mm: beyond, steps/mm or a speed in mm/s was meant."""

    steps_per_unit: Annotated[float, Field(ge=1e4, le=1e7)]
    max_speed_unit_per_s: Annotated[float, Field(gt=0, le=2)]
    max_accel_unit_per_s2: Annotated[float, Field(gt=0, le=50)]
    min_unit: Annotated[float, Field(ge=-1, le=1)]
    max_unit: Annotated[float, Field(ge=-1, le=1)]
    home_unit: Annotated[float, Field(ge=-1, le=1)] = 0.0


class RotaryStage(StageSection):
    """Roll or knob; `unit` is rad. From 188 steps a turn, no gear, to a microstepped gear of 1 to 100."""

    steps_per_unit: Annotated[float, Field(ge=30, le=3e5)]
    max_speed_unit_per_s: Annotated[float, Field(gt=0, le=100)]
    max_accel_unit_per_s2: Annotated[float, Field(gt=0, le=1e4)]
    min_unit: Annotated[float, Field(ge=-50, le=50)]
    max_unit: Annotated[float, Field(ge=-50, le=50)]
    home_unit: Annotated[float, Field(ge=-50, le=50)] = 0.0


class StagesSection(_Section):
    """The stepper axes: insertion, roll and knob."""

    insertion: InsertionStage
    roll: RotaryStage
    knob: RotaryStage


class CatheterSection(_Section):
    """The catheter in the handle: `name` of its file, exposed length and largest curvature that the knob makes."""

    name: str
    distal_length_m: Annotated[float, Field(gt=0.01, le=0.3)]
    max_curvature_per_m: Annotated[float, Field(gt=0, le=100)]


class TransmissionSection(_Section):
    """Handle to distal end, as characterized on this rig (thesis 6.2)."""

    catheter: str
    insertion_at_home_m: Annotated[float, Field(ge=-0.5, le=0.5)]
    insertion_backlash_m: Annotated[float, Field(ge=0, le=0.02)]
    insertion_slope: Annotated[float, Field(gt=0.2, le=2)]
    roll_slope: Annotated[float, Field(gt=0.05, le=2)]
    knob_rad: list[Annotated[float, Field(ge=-50, le=50)]]
    curvature_per_m: list[Annotated[float, Field(ge=-200, le=200)]]
    wire_turning_rad: Annotated[float, Field(ge=0, le=20)] = 0.0

    @model_validator(mode="after")
    def _monotone_curve(self) -> TransmissionSection:
        if len(self.knob_rad) != len(self.curvature_per_m) or len(self.knob_rad) < 3:
            raise ValueError("knob_rad and curvature_per_m of one length, at least 3")
        if any(b <= a for a, b in zip(self.knob_rad, self.knob_rad[1:], strict=False)):
            raise ValueError("knob_rad strictly increasing")
        if any(b < a for a, b in zip(self.curvature_per_m, self.curvature_per_m[1:], strict=False)):
            raise ValueError("curvature_per_m never decreasing along knob_rad")
        if self.curvature_per_m[-1] <= self.curvature_per_m[0]:
            raise ValueError("curvature_per_m that rises somewhere: a knob that bends the catheter")
        return self


class TrackedTool(NamedTuple):
    """A sensor on the catheter: its name in topics and keys, its handle at the tracker, its file, its place."""

    name: str  # "tip", "shaft" or "rear"
    handle: str
    definition: str  # file of an Aurora tool without a memory of its own; empty for a tool that has one
    offset_m: float  # arc length from the tip back to it

    @property
    def topic(self) -> str:
        """Return the topic of its poses."""
        return f"pose/{self.name}"


class Tracker(_Section):
    """The tracker. `base_from_tracker_*` registers its frame to the base frame at the sheath's exit.

    kind: "aurora" (NDI, serial port), "openigtlink" (a server, `port` is HOST:PORT, handles are names of transforms), or the
    name of a plug-in; `options` are the plug-in's own keys (docs/devices.md). *_definition: file that defines an Aurora
    tool without a memory of its own; empty for a tool that has one. rear_*: a third sensor, behind that of the shaft;
    without rear_handle there is none.
    """

    kind: Kind = "aurora"
    options: Options = {}
    port: str
    rate_hz: Annotated[float, Field(gt=1, le=200)]
    latency_s: Annotated[float, Field(ge=0, le=0.2)]
    tip_handle: str = "0A"
    shaft_handle: str = "0B"
    tip_definition: str = ""
    shaft_definition: str = ""
    shaft_sensor_offset_m: Annotated[float, Field(gt=0, le=0.2)]
    rear_handle: str = ""
    rear_definition: str = ""
    rear_sensor_offset_m: Annotated[float, Field(ge=0, le=0.2)] = 0.0
    position_noise_m: Annotated[float, Field(gt=0, le=0.01)]
    orientation_noise_rad: Annotated[float, Field(gt=0, le=0.3)]
    base_from_tracker_m: Vector3
    base_from_tracker_wxyz: Quaternion

    @property
    def tools(self) -> tuple[TrackedTool, ...]:
        """Return the sensors from the tip backwards: tip, shaft and, where the file has one, rear."""
        tools = (
            TrackedTool("tip", self.tip_handle, self.tip_definition, 0.0),
            TrackedTool("shaft", self.shaft_handle, self.shaft_definition, self.shaft_sensor_offset_m),
            TrackedTool("rear", self.rear_handle, self.rear_definition, self.rear_sensor_offset_m),
        )
        return tools if self.rear_handle else tools[:2]

    @property
    def tool_offsets_m(self) -> tuple[float, ...]:
        """Return the sensors' arc lengths from the tip backwards (m), 0 for the first."""
        return tuple(tool.offset_m for tool in self.tools)

    @model_validator(mode="after")
    def _addressed(self) -> Tracker:
        """Check the address and the names of the tools: a mistake there would be a tracker that never sends."""
        if not self.port.strip():
            raise ValueError("port that is not empty, such as /dev/serial/by-id/...")
        if not self.tip_handle.strip() or self.tip_handle == self.shaft_handle:
            raise ValueError("tip_handle and shaft_handle of two different tools")
        for tool in self.tools:
            if self.kind == "aurora" and not re.fullmatch(r"[0-9A-F]{2}", tool.handle):
                raise ValueError(
                    f'{tool.name}_handle of two characters 0 to 9 and A to F, as the Aurora numbers its tools, such as "0A"'
                )
            if self.kind != "aurora" and tool.definition:
                raise ValueError(f'{tool.name}_definition: only for kind = "aurora"; leave it out')
        if self.kind == "openigtlink":
            found = re.fullmatch(r"(\[[0-9A-Fa-f:]+\]|[A-Za-z0-9._-]+)(?::([0-9]{1,5}))?", self.port)
            if found is None or not 0 < int(found[2] or 1) < 65536:
                raise ValueError("port: HOST:PORT of the OpenIGTLink server, such as 127.0.0.1:18944")
        return self

    @model_validator(mode="after")
    def _third(self) -> Tracker:
        """Check that a third sensor is described whole, and lies behind the second."""
        if not self.rear_handle:
            for key in ("rear_definition", "rear_sensor_offset_m"):
                if getattr(self, key):
                    raise ValueError(f"rear_handle: the third sensor's, as {key} is given; or leave {key} out")
            return self
        if not self.rear_handle.strip() or self.rear_handle in (self.tip_handle, self.shaft_handle):
            raise ValueError("rear_handle of a third tool, other than tip_handle and shaft_handle")
        if self.rear_sensor_offset_m <= self.shaft_sensor_offset_m:
            raise ValueError("rear_sensor_offset_m above shaft_sensor_offset_m: the third sensor is behind the second")
        return self

    @model_validator(mode="after")
    def _unit(self) -> Tracker:
        if abs(math.hypot(*self.base_from_tracker_wxyz) - 1) > 1e-3:
            raise ValueError("base_from_tracker_wxyz of unit length")
        return self


class ForceSensorSection(_Section):
    """The force sensor; `base_from_sensor_wxyz` turns its reading into the force on the tissue.

    kind: "net_ft" (ATI box, `address` of the box), "nano17" (data acquisition card, `address` is its name,
    options.calibration the transducer's .cal file), or the name of a plug-in. Only a box needs the counts.
    """

    kind: Kind = "net_ft"
    options: Options = {}
    address: str
    counts_per_newton: Annotated[float, Field(ge=1, le=1e9)]
    counts_per_newton_metre: Annotated[float, Field(ge=1, le=1e12)]
    rate_hz: Annotated[float, Field(gt=1, le=7000)]
    noise_N: Annotated[float, Field(gt=0, le=0.2)]
    range_N: Annotated[float, Field(ge=0.5, le=1000)]
    base_from_sensor_wxyz: Quaternion

    @model_validator(mode="before")
    @classmethod
    def _no_counts(cls, data: Any) -> Any:
        if isinstance(data, dict) and data.get("kind", "net_ft") != "net_ft":
            return {"counts_per_newton": 1.0, "counts_per_newton_metre": 1.0, **data}
        return data

    @model_validator(mode="after")
    def _addressed(self) -> ForceSensorSection:
        if not self.address.strip():
            raise ValueError("address that is not empty")
        if self.kind == "net_ft" and not re.fullmatch(r"[A-Za-z0-9._:-]+", self.address):
            raise ValueError("address of the box: a host name or IP address alone, such as 192.168.1.1")
        return self

    @model_validator(mode="after")
    def _unit(self) -> ForceSensorSection:
        if abs(math.hypot(*self.base_from_sensor_wxyz) - 1) > 1e-3:
            raise ValueError("base_from_sensor_wxyz of unit length")
        return self


class Pins(_Section):
    """A port each of the board's processor for outputs, encoders and switches, and the polarities of the signals.

    `normally_open` names switches (protocol/board_pins.py, SWITCHES); all others are normally closed. `keep_enabled`
    leaves the drives powered on a fault, until they are disarmed: for a vertical axis, which would fall.
    """

    mcu: Literal["atmega2560", "atmega328p"] = "atmega2560"
    outputs: str
    output_shift: Annotated[int, Field(ge=0, le=7)]
    encoders: str
    switches: str
    enable_active: Literal["low", "high"] = "low"
    normally_open: Annotated[tuple[str, ...], Field(strict=False)] = ()
    keep_enabled: bool = False

    @model_validator(mode="before")
    @classmethod
    def _usual(cls, data: Any) -> Any:
        chip = board_pins.PROCESSORS.get(data.get("mcu", "atmega2560")) if isinstance(data, dict) else None
        return {**chip.usual, **data} if chip else data

    @model_validator(mode="after")
    def _free(self) -> Pins:
        problem = board_pins.problem_of(**self.ports(), normally_open=self.normally_open)
        if problem:
            raise ValueError(problem)
        return self

    def ports(self) -> dict[str, Any]:
        """The pins without the polarities: the arguments of `board_pins.signals`."""
        return self.model_dump(include={"mcu", "outputs", "output_shift", "encoders", "switches"})

    def build(self) -> board_pins.Build:
        """Where and with what variables the firmware is built for these pins."""
        return board_pins.build_of(board_pins.definitions(**self.model_dump()))


class BoardSection(_Section):
    """The stepper board: its serial port, how far ahead set-points are sent, how long they hold, its pins."""

    port: Annotated[str, Field(min_length=1)]
    baud: Annotated[int, Field(gt=9600, le=1_000_000)]
    setpoint_lead_s: Annotated[float, Field(ge=0.001, le=0.004)]
    setpoint_expiry_s: Annotated[float, Field(ge=0.001, le=0.02)]
    pins: Pins = Pins.model_validate({})


class ControlSection(_Section):
    """Gains in physical units per second: they hold at any loop rate."""

    loop_hz: Annotated[int, Field(ge=100, le=4000)]
    position_gain_per_s: Annotated[float, Field(ge=0, le=50)]
    position_integral_per_s2: Annotated[float, Field(ge=0, le=200)]
    force_gain_m_per_N: Annotated[float, Field(ge=0, le=0.1)]
    force_integral_m_per_N_s: Annotated[float, Field(ge=0, le=0.5)]
    approach_speed_m_per_s: Annotated[float, Field(gt=0, le=0.02)]
    contact_force_N: Annotated[float, Field(gt=0.005, le=0.1)]
    reversal_threshold_m: Annotated[float, Field(ge=0, le=0.002)]
    acceleration_noise_m_per_s2: Annotated[float, Field(gt=0, le=100)]
    law: Literal["thesis", "predictive"] = "predictive"
    form: Literal["pi", "incremental"] = "pi"
    force_added_to: Literal["desired", "tip"] = "desired"
    pi_position_gain: Annotated[float, Field(ge=0, le=2)] = 0.083
    pi_position_integral_per_s: Annotated[float, Field(ge=0, le=50)] = 0.24
    pi_force_gain_m_per_N: Annotated[float, Field(ge=0, le=0.5)] = 0.1
    pi_force_integral_m_per_N_s: Annotated[float, Field(ge=0, le=1)] = 0.12
    force_frame: Literal["base", "tip"] = "base"
    move_speed_m_per_s: Annotated[float, Field(gt=0, le=0.05)] = 0.03
    move_accel_m_per_s2: Annotated[float, Field(gt=0, le=2)] = 0.2
    slide_speed_m_per_s: Annotated[float, Field(gt=0, le=0.02)] = 0.005
    offset_memory_s: Annotated[float, Field(ge=0.05, le=10)] = 0.4
    contact_memory_s: Annotated[float, Field(ge=0.05, le=30)] = 1.0
    force_slew_N_per_s: Annotated[float, Field(gt=0, le=2)] = 0.3
    force_margin_N: Annotated[float, Field(ge=0, le=0.1)] = 0.04
    tip_compliance_m_per_N: Annotated[float, Field(gt=1e-4, le=0.1)] = 0.01
    stiffness_sd: Annotated[float, Field(ge=0, le=0.5)] = 0.05
    reversal_share: Annotated[float, Field(ge=0, le=2)] = 0.75
    reversal_depth_m: Annotated[float, Field(ge=0, le=0.002)] = 0.0001
    play_noise_m: Annotated[float, Field(gt=0, le=0.01)] = 0.00003
    blind_approach_share: Annotated[float, Field(gt=0, le=1)] = 0.5
    play_caution_m: Annotated[float, Field(ge=0, le=0.001)] = 0.0003
    play_sd_m: Annotated[float, Field(ge=0, le=0.001)] = 0.0003

    @model_validator(mode="after")
    def _stable(self) -> ControlSection:
        if self.position_gain_per_s / self.loop_hz > 0.5:
            raise ValueError("position_gain_per_s at most half of loop_hz, beyond it the loop is unstable")
        return self


class EstimationSection(_Section):
    """The force estimator of the model process, and the uncertainty of joints and stiffness.

    `*_sd_*`: standard deviations of what lasts; `*_walk_*`: growth of the joints' errors in one second at rest.
    """

    model: Literal["planar", "spatial"] = "spatial"
    insertion_sd_m: Annotated[float, Field(gt=0, le=0.01)] = 0.0003
    curvature_sd_per_m: Annotated[float, Field(gt=0, le=20)] = 0.5
    roll_sd_rad: Annotated[float, Field(gt=0, le=1)] = 0.1
    stiffness_sd: Annotated[float, Field(ge=0, le=0.5)] = 0.05
    free_force_sd_N: Annotated[float, Field(gt=0, le=10)] = 0.05
    contact_force_sd_N: Annotated[float, Field(gt=0, le=10)] = 1.0
    tangential_force_sd_N: Annotated[float, Field(gt=0, le=1)] = 0.02
    insertion_walk_m: Annotated[float, Field(gt=0, le=0.01)] = 0.0001
    curvature_walk_per_m: Annotated[float, Field(gt=0, le=20)] = 0.03
    roll_walk_rad: Annotated[float, Field(gt=0, le=1)] = 0.1
    adaptation: bool = True
    adaptation_limit: Annotated[float, Field(gt=0, le=0.3)] = 0.3
    adaptation_sd: Annotated[float, Field(gt=0, le=0.5)] = 0.1
    curvature_exponent: Annotated[float, Field(ge=0, le=1)] = 0.5
    contact_watch: bool = True


class Safety(_Section):
    """Limits of force, missing data, speed and place. `HARD_*` bound them: no rig file can widen those.

    Lower bounds: below them a retraction leads nowhere, or every pose is refused; such a value is one in another unit.
    """

    over_force_N: Annotated[float, Field(ge=0.05, le=HARD_MAX_FORCE_N)]
    hold_after_s: Annotated[float, Field(gt=0, le=HARD_STOP_AFTER_S)]
    stop_after_s: Annotated[float, Field(gt=0, le=HARD_STOP_AFTER_S)]
    force_timeout_s: Annotated[float, Field(gt=0, le=HARD_STOP_AFTER_S)]
    retract_speed_m_per_s: Annotated[float, Field(ge=0.005, le=0.05)]
    retract_distance_m: Annotated[float, Field(ge=0.003, le=0.05)]
    retract_stopped: bool = True
    host_lost_after_s: Annotated[float, Field(ge=0.25, le=10)] = 2.0
    max_tip_speed_m_per_s: Annotated[float, Field(ge=0.02, le=1)]
    workspace_min_m: Vector3
    workspace_max_m: Vector3

    @model_validator(mode="after")
    def _ordered(self) -> Safety:
        if self.hold_after_s > self.stop_after_s:
            raise ValueError("hold_after_s at most stop_after_s")
        if any(a >= b for a, b in zip(self.workspace_min_m, self.workspace_max_m, strict=True)):
            raise ValueError("workspace_min_m below workspace_max_m")
        return self


class Zenoh(_Section):
    """How programs of this computer reach the rig: the folder of its sockets, and endpoints that are opened in addition.

    The model process listens on a unix socket in `folder` and on `listen`; the others connect to `connect`, where that is
    empty to the socket. An endpoint tcp/127.0.0.1:PORT admits every program of every user of this computer.
    """

    folder: str = ""
    listen: list[str] = []
    connect: list[str] = []

    @model_validator(mode="after")
    def _absolute(self) -> Zenoh:
        if self.folder and not re.fullmatch(r"/[^\s#?;]*", self.folder):
            raise ValueError("folder: an absolute path without spaces, #, ? and ;")
        return self


class NetworkAccess(_Section):
    """Other machines: where they reach the rig, with whose keys, who may read and who command. Empty: no one."""

    listen: list[str] = []
    keys: str = ""
    peers: list[str] = []
    readers: list[str] = []
    commanders: list[str] = []

    @model_validator(mode="after")
    def _sound(self) -> NetworkAccess:
        for endpoint in self.listen:
            check_network_endpoint(endpoint)
        for name in self.readers + self.commanders:
            check_name(name)
        for peer in self.peers:
            ipaddress.ip_network(peer)
        if len({*self.readers, *self.commanders}) < len(self.readers + self.commanders):
            raise ValueError("every name once in readers and commanders (a commander reads too)")
        if self.listen and not Path(self.keys).is_absolute():
            raise ValueError("keys: an absolute path, of the folder that `seldinger keys issue RIG --role rig` made")
        return self


class Rig(_Section):
    """Content of a rig file. Axis order everywhere: insertion (m), roll (rad), knob (rad)."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_]+$")]
    catheter: CatheterSection
    stages: StagesSection
    transmission: TransmissionSection
    tracker: Tracker
    force_sensor: ForceSensorSection
    board: BoardSection
    control: ControlSection
    estimation: EstimationSection = EstimationSection()
    safety: Safety
    zenoh: Zenoh = Zenoh()
    network: NetworkAccess = NetworkAccess()

    @model_validator(mode="after")
    def _calibration_fits(self) -> Rig:
        if self.transmission.catheter != self.catheter.name:
            raise ValueError(
                f"transmission.catheter: found {self.transmission.catheter}, wanted {self.catheter.name}, as "
                "catheter.name: it was calibrated with another catheter"
            )
        return self

    @model_validator(mode="after")
    def _insertion_moves(self) -> Rig:
        """Check that the insertion can do what approach and retraction ask: else a speed or travel is in another unit."""
        stage, least_m = self.stages.insertion, self.safety.retract_distance_m
        for key, speed in (
            ("safety.retract_speed_m_per_s", self.safety.retract_speed_m_per_s),
            ("control.approach_speed_m_per_s", self.control.approach_speed_m_per_s),
        ):
            if stage.max_speed_unit_per_s < speed:
                found = stage.max_speed_unit_per_s
                raise ValueError(f"stages.insertion.max_speed_unit_per_s: found {found:g}, wanted at least {key} {speed:g}")
        if stage.max_unit - stage.min_unit < 2.0 * least_m:
            raise ValueError(
                f"stages.insertion: found a travel of {stage.max_unit - stage.min_unit:g} m, wanted at least twice "
                f"safety.retract_distance_m {least_m:g}"
            )
        return self

    @model_validator(mode="after")
    def _gains_hold(self) -> Rig:
        c, turns_s = self.control, 1.5 / self.control.loop_hz + self.board.setpoint_lead_s
        if c.law != "thesis":
            return self
        late_s = self.tracker.latency_s + 0.5 / self.tracker.rate_hz + turns_s
        if c.form == "pi":
            return self._pi_gains_hold(late_s, turns_s)
        gains = (c.position_gain_per_s, c.position_integral_per_s2)
        margins = {
            "position": (loop_margin.position_margin_deg(*gains, late_s), late_s),
            "force": (
                loop_margin.force_margin_deg(
                    *gains, c.force_gain_m_per_N, c.force_integral_m_per_N_s, 1.0 / c.tip_compliance_m_per_N, turns_s
                ),
                turns_s,
            ),
        }
        for loop, (margin_deg, delay_s) in margins.items():
            if not margin_deg >= loop_margin.LEAST_MARGIN_deg:
                raise ValueError(
                    f"control: found gains with a phase margin of {margin_deg:.0f} degrees in the {loop} loop "
                    f"(at {c.loop_hz} Hz, {delay_s * 1e3:.0f} ms late), wanted at least "
                    f"{loop_margin.LEAST_MARGIN_deg:.0f}: less gain, or less integral"
                )
        return self

    def _pi_gains_hold(self, late_s: float, turns_s: float) -> Rig:
        c = self.control
        joint = loop_margin.ProportionalIntegral(c.pi_position_gain, c.pi_position_integral_per_s)
        force = loop_margin.ProportionalIntegral(
            c.pi_force_gain_m_per_N / c.tip_compliance_m_per_N, c.pi_force_integral_m_per_N_s / c.tip_compliance_m_per_N
        )
        for loop, parts, delay_s in (("position", (joint,), late_s), ("force", (joint, force), turns_s)):
            margin_deg = loop_margin.pi_margin_deg(parts, delay_s)
            if not margin_deg >= loop_margin.LEAST_MARGIN_deg:
                raise ValueError(
                    f"control: found gains of the PI form with a phase margin of {margin_deg:.0f} degrees in the "
                    f"{loop} loop ({delay_s * 1e3:.0f} ms late), wanted at least {loop_margin.LEAST_MARGIN_deg:.0f}: "
                    "less pi_* gain"
                )
        return self

    @model_validator(mode="after")
    def _rates_fit(self) -> Rig:
        """A rate at which every sample, or every set-point, would be late is refused before anything starts."""
        for key, found_s, wanted_s, why in (
            ("safety.hold_after_s", self.safety.hold_after_s, 1.0 / self.tracker.rate_hz, "a period of tracker.rate_hz"),
            (
                "safety.force_timeout_s",
                self.safety.force_timeout_s,
                1.0 / self.force_sensor.rate_hz,
                "a period of force_sensor",
            ),
            (
                "board.setpoint_expiry_s",
                self.board.setpoint_expiry_s,
                1.0 / self.control.loop_hz,
                "a period of control.loop_hz",
            ),
        ):
            if not found_s >= wanted_s:
                raise ValueError(f"{key}: found {found_s:g}, wanted at least {wanted_s:.4g}, {why}")
        return self

    def stage(self, axis: int) -> StageSection:
        """Return the stage of axis 0 insertion, 1 roll or 2 knob."""
        return (self.stages.insertion, self.stages.roll, self.stages.knob)[axis]

    @property
    def local(self) -> LocalPaths:
        """Return the rig's folder on this computer."""
        return local_paths(self.name, self.zenoh.folder)

    @property
    def listen_endpoints(self) -> list[str]:
        """Return the endpoints at which the model process listens for programs of this computer."""
        return [self.local.endpoint, *self.zenoh.listen]

    @property
    def connect_endpoints(self) -> list[str]:
        """Return the endpoints to which all other processes connect."""
        return self.zenoh.connect or [self.local.endpoint]

    @property
    def access(self) -> Network | None:
        """What other machines may do here; None where nothing leaves this one."""
        n = self.network
        return Network(self.name, tuple(n.listen), Path(n.keys), tuple(n.readers), tuple(n.commanders)) if n.listen else None

    def effective(self) -> dict[str, Any]:
        """Return the whole effective configuration, for the recording's header."""
        return self.model_dump(mode="json")


def _bounds(error: Any) -> str:
    context = error.get("ctx") or {}
    limits = [
        f"{word} {context[key]}"
        for key, word in (("gt", "above"), ("ge", "at least"), ("lt", "below"), ("le", "at most"))
        if key in context
    ]
    return (" and ".join(limits) or wanted_of(error)) + hint_of(error)


def _shown(value: object) -> str:
    return repr(value)[:80]


def _describe(error: Any) -> str:
    """One of pydantic's errors as key, what was found, what is wanted."""
    key = ".".join(str(part) for part in error["loc"]) or "rig"
    if error["type"] == "extra_forbidden":
        wanted = unknown_key(str(error["loc"][-1]), known_keys(Rig, error["loc"]))
        return f"{key}: found {_shown(error['input'])}, wanted {wanted}"
    if error["type"] == "missing":
        return f"{key}: found nothing, wanted a value (see protocol/rigs/simulated.toml for what it means)"
    said = error["msg"].removeprefix("Value error, ")
    if ": found " in said:
        return said if not error["loc"] or said.startswith(f"{error['loc'][0]}") else f"{key}: {said}"
    if isinstance(error["input"], dict) and error["loc"]:  # a check of a whole section: show the keys that it names
        named = [f"{name} = {value}" for name, value in error["input"].items() if re.search(rf"\b{name}\b", said)]
        return f"{key}: found {', '.join(named) or 'this section'}, wanted {said}"
    return f"{key}: found {_shown(error['input'])}, wanted {_bounds(error)}"


def problems_of(data: dict[str, Any]) -> list[str]:
    """Return all mistakes in `data`, one line each; empty for a good rig file."""
    try:
        Rig.model_validate(data)
    except ValidationError as problem:
        return [_describe(error) for error in problem.errors()]
    return []


def parse_rig(data: dict[str, Any], name: str = "rig file") -> Rig:
    """Return `data` as a checked `Rig`. Raises InputError with the first offending key."""
    try:
        return Rig.model_validate(data)
    except ValidationError as problem:
        raise InputError.from_sentence(f"{name}: {_describe(first_of(problem.errors()))}") from None


def read_rig_data(path: str | Path) -> dict[str, Any]:
    """Read the TOML file `path` without checks. Raises InputError if it cannot be read."""
    return read_toml(path)


def catheter_problems(rig: Rig) -> list[str]:
    """A line where the named catheter is unknown, or its length is not the one in the rig file."""
    try:
        length_m = load_catheter(rig.catheter.name).distal_length_m
    except (ValueError, OSError) as error:
        return [f"catheter.name: found {rig.catheter.name!r}, wanted a catheter that ships or its file ({error})"]
    if abs(length_m - rig.catheter.distal_length_m) <= DISTAL_TOLERANCE_M:
        return []
    return [
        f"catheter.distal_length_m: found {rig.catheter.distal_length_m}, wanted about {length_m}, which "
        f"{rig.catheter.name} has"
    ]


def unusual_values(rig: Rig) -> list[str]:
    """Return a line for each accepted value that is probably in another unit, for a warning."""
    ranges = RIG | NET_FT if rig.force_sensor.kind == "net_ft" else RIG
    return unusual(rig.effective(), ranges)


def load_rig(path: str | Path) -> Rig:
    """Load the rig in TOML file `path`, checked as `seldinger rig check` does; warn (UnusualValue) of unusual values.

    Raises InputError (unreadable file, unknown key, value out of its bounds, another catheter).
    """
    rig = parse_rig(read_rig_data(path), str(path))
    for problem in catheter_problems(rig):
        raise InputError.from_sentence(f"{path}: {problem}")
    warn_of(unusual_values(rig), str(path))
    return rig
