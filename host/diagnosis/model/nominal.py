"""The nominal TOML: which columns are which channels, how recordings are split, and which law is taken for granted."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, AliasChoices, Field, PrivateAttr, field_validator, model_validator

from host.diagnosis.model import units
from protocol.errors import InputError
from protocol.requests import Request, validate
from protocol.text_files import read_toml

Term = TypeVar("Term", bound=str)


def _each_once(terms: list[Term]) -> list[Term]:
    if not terms or len(set(terms)) < len(terms):
        raise ValueError("at least one term, and each once")
    return terms


# A unit as a user writes it, in the one spelling of `host.diagnosis.model.units`.
Unit = Annotated[str, AfterValidator(units.unit)]
Terms = Annotated[list[Term], AfterValidator(_each_once)]


class ChannelSpec(Request):
    """One channel: SI value = sign * scale * column + offset."""

    column: str
    scale: float = 1.0
    unit: Unit = ""
    sign: Literal[-1, 1] = 1
    offset: float = 0.0
    session_offset: bool = (
        False  # an offset of its own in every recording, estimated (simulators, outputs of a transmission)
    )

    @model_validator(mode="after")
    def _unit_of_the_value(self) -> ChannelSpec:
        # scale = 0.001 with unit = "mm" names the unit of the column: the value itself is then in m.
        if self.unit and self.scale != 1.0 and math.isclose(abs(self.scale), units.size(self.unit), rel_tol=1e-4):
            self.unit = units.coherent(self.unit)
        return self


class SegmentSpec(Request):
    """One recording inside a file: `rows` first (inclusive) and last (exclusive)."""

    name: str
    rows: list[int] = Field(min_length=2, max_length=2)
    file: str = "*"


class DataSpec(Request):
    """Files of the recordings, their time, and the split into fitted and held-out ones."""

    files: list[str] = []
    time: str | None = None
    time_scale: float = Field(default=1.0, gt=0)  # seconds = time_scale * column
    rate_Hz: float | None = Field(default=None, gt=0)
    heldout: list[str] | None = None
    segments: list[SegmentSpec] = Field(default=[], validation_alias=AliasChoices("segments", "pieces"))
    lead_rows: int = Field(default=0, ge=0)
    by: str | None = None  # column of a file in which several recordings follow each other: a new value begins a new one


class ParameterSpec(Request):
    """A nominal parameter: start value, whether it is refitted, bounds of the fit, and unit."""

    value: float
    free: bool = True
    low: float | None = None
    high: float | None = None
    unit: Unit = ""

    @model_validator(mode="after")
    def _inside(self) -> ParameterSpec:
        low, high = self.bounds()
        if not low <= self.value <= high:
            raise ValueError(f"low <= value <= high, with value {self.value:g}")
        return self

    def bounds(self) -> tuple[float, float]:
        """Bounds of the fit; infinite where none is given."""
        return (-math.inf if self.low is None else self.low, math.inf if self.high is None else self.high)


class OfferSpec(Request):
    """A parameter of the simulator that is nominally `off` and competes with the effects, under an id of the vocabulary."""

    id: str
    parameter: str
    subsystem: str = ""
    off: float = 0.0
    low: float = 0.0
    high: float
    tried: list[float] = []  # values that screening tries; left out, five between the bounds
    unit: Unit = ""

    @model_validator(mode="after")
    def _inside(self) -> OfferSpec:
        if not self.low <= self.off <= self.high or self.low >= self.high:
            raise ValueError(f"low <= off <= high and low < high, with off {self.off:g}")
        return self


class StateSpec(Request):
    """A state at the first sample of a recording that no output shows: mean and standard deviation before the fit."""

    value: float = 0.0
    spread: float = Field(gt=0)


class SimulatorSpec(Request):
    """Common section of kinds that run a simulator: input and output channels, ports, and initial states.

    `ports`: channel -> subsystem in the verdict; channels without one belong to `subsystem`. `forces_inside`: whether
    forces along measured motions compete from the start; else they are tried where nothing else explains the outputs.
    """

    forces_inside: bool = False
    inputs: list[str]
    outputs: list[str] = Field(min_length=1)
    subsystem: str = "model"
    ports: dict[str, str] = {}
    load: list[str] = []
    states: dict[str, StateSpec] = {}

    @model_validator(mode="after")
    def _ports_exist(self) -> SimulatorSpec:
        for name in self.ports:
            if name not in (*self.inputs, *self.outputs):
                raise ValueError(f"ports of inputs or outputs, not {name}")
        return self


class LinkSpec(Request):
    """One transmission from a motion to a motion ([[link]])."""

    subsystem: str = "transmission"
    input: str
    output: str
    load: list[str] = []
    others: list[str] = []
    lag_order: int = Field(default=0, ge=0, le=2)


class ControllerSpec(Request):
    """Cascade of position and velocity loops: force = gain * kv * (kp * (reference - x) - v) + added, limited.

    `added`: channel of a known force on top of the controller's, zero in recordings without it.
    """

    reference: str
    added: str = ""
    position_gain_per_s: float
    velocity_gain: float
    force_gain: float = 1.0
    force_limit: float = Field(default=1e300, gt=0)


class AxisSpec(Request):
    """Force in, motion out: mass * a + damping * v + stiffness * x = force + offset.

    `hold`: the force between samples; left out, a free mass takes what fits its recordings best, others `linear`.
    `compare`: of a free mass whose position is read, the simulated motion or the force that the measured motion needs; left
    out, the motion if all recordings can be simulated down to their white noise, else the force.
    """

    subsystem: str = "axis"
    input: str
    output: str
    terms: Terms[Literal["mass", "damping", "stiffness", "offset"]] = ["mass", "damping", "offset"]
    reads: Literal["position", "velocity", "acceleration"] = "position"
    hold: Literal["zero", "linear", "band_limited"] | None = None
    compare: Literal["motion", "force"] | None = None
    controller: ControllerSpec | None = None

    @property
    def runs_away(self) -> bool:
        """Whether small errors of the force add up in a simulation: a free mass, of which only the position is read."""
        return self.controller is None and "stiffness" not in self.terms and self.reads == "position"


class ImpedanceSpec(Request):
    """A material or spring: motion is the input, force the output ([impedance])."""

    subsystem: str = "impedance"
    input: str
    output: str
    load: list[str] = []
    others: list[str] = []
    terms: Terms[Literal["mass", "damping", "stiffness", "load", "offset"]] = ["stiffness", "offset"]


class CallableSpec(SimulatorSpec):
    """A Python function `name(inputs, parameters, time_s) -> outputs`, dictionaries of arrays (n,).

    A function with a fourth argument gets the state at the first sample: each output and its rate (`angle`,
    `angle_rate`), and `states`. `function`: `module:name`, or from Python the function itself. `workers`: processes that
    may run recordings in parallel (threads, where processes cannot be forked).
    """

    function: Any
    workers: int = Field(default=1, ge=1, le=64)

    @field_validator("function")
    @classmethod
    def _runs(cls, function: Any) -> Any:
        if not isinstance(function, str) and not callable(function):
            raise ValueError("module:name of a Python function, or from Python the function itself")
        return function


Coefficient = float | str  # a number, or an expression of parameters


class FeedbackSpec(Request):
    """A loop around a linear model: its input is what the controller makes of `reference` minus `output`.

    numerator, denominator: of the controller, in falling powers of s (of z with `period_s`). `actuation`: the output that
    recorded the plant's input.
    """

    reference: str
    output: str
    numerator: list[Coefficient] = Field(min_length=1)
    denominator: list[Coefficient] = Field(default=[1.0], min_length=1)
    actuation: str = ""


class LinearSpec(SimulatorSpec):
    """Transfer function (one input, one output; falling powers of s or z), or state space, of any order.

    Coefficients are numbers or expressions of parameters. `period_s`: of a discrete model, left out for a continuous one;
    `hold`: its input between samples; with feedback, whether the controller works once a sample or continuously.
    """

    subsystem: str = "plant"
    numerator: list[Coefficient] | None = None
    denominator: list[Coefficient] | None = None
    A: list[list[Coefficient]] | None = None
    B: list[list[Coefficient]] | None = None
    C: list[list[Coefficient]] | None = None
    D: list[list[Coefficient]] | None = None
    period_s: float | None = Field(default=None, gt=0)
    hold: Literal["zero", "linear", "held_reference"] = "zero"
    feedback: FeedbackSpec | None = None

    @model_validator(mode="after")
    def _one_form(self) -> LinearSpec:
        transfer = self.numerator is not None and self.denominator is not None
        space = self.A is not None and self.B is not None and self.C is not None
        if transfer == space:
            raise ValueError("either numerator and denominator, or A, B and C (and D)")
        actuation = self.feedback.actuation if self.feedback is not None else ""
        compared = [name for name in self.outputs if name != actuation]
        if transfer and (len(self.inputs), len(compared)) != (1, 1):
            raise ValueError(
                "one input and one output for a transfer function, and the output that is the actuation of linear.feedback; "
                "A, B, C and D for more"
            )
        return self


class MujocoSpec(SimulatorSpec):
    """A model file of MuJoCo (MJCF). `actuators`, `sensors`: channel -> name in the file.

    A parameter is named `element.attribute` (`hinge.damping`, `forearm.mass`, `motor.gear`). `offers`: what competes,
    and [[offer]]: `all` that MuJoCo has for the joints, actuators and bodies in use, or `none`.
    """

    model: str
    subsystem: str = "mechanism"
    actuators: dict[str, str] = {}
    sensors: dict[str, str] = {}
    offers: Literal["all", "none"] = "all"

    @model_validator(mode="before")
    @classmethod
    def _channels(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        return {"inputs": list(given.get("actuators", {})), "outputs": list(given.get("sensors", {})), **given}


class FmuSpec(SimulatorSpec):
    """A functional mock-up unit for co-simulation. A parameter bears the name of its FMI variable.

    `variables`: channel -> FMI variable, where the names differ. `initial`: state at the first sample (an output, its
    rate, such as `angle_rate`, or one of `states`) -> FMI variable that starts it.
    """

    model: str
    subsystem: str = "unit"
    variables: dict[str, str] = {}
    initial: dict[str, str] = {}

    @model_validator(mode="after")
    def _known(self) -> FmuSpec:
        for name in self.variables:
            if name not in (*self.inputs, *self.outputs):
                raise ValueError(f"variables of inputs or outputs, not {name}")
        begins = {*self.states, *self.outputs, *(f"{name}_rate" for name in self.outputs)}
        for name in self.initial:
            if name not in begins:
                raise ValueError(f"initial of {', '.join(sorted(begins))}, not {name}")
        for name in self.states:
            if name not in self.initial:
                raise ValueError(f"initial with a variable for the state {name}")
        return self


class RigSpec(Request):
    """Geometry of the catheter rig that is held; what may be refitted stands under `parameters`."""

    distal_length_m: float = Field(default=0.110, gt=0)
    shaft_sensor_offset_m: float = Field(default=0.030, gt=0)
    torsion_to_bending: float = Field(default=0.77, gt=0)
    wall_normal: list[float] = Field(default=[0.0, 0.0, 1.0], min_length=3, max_length=3)
    recorded: bool = False  # all of it, and the catheter, from the configuration that recordings of a running rig carry


class EffectSpec(Request):
    """An effect that is known to be there: id and port or subsystem, its parameters by their keys, refitted unless
    `free = false`.
    """

    id: str
    at: str
    values: dict[str, float] = {}
    source: str = ""
    form: str = ""
    free: bool = True


class NominalSpec(Request):
    """Content of a nominal TOML file."""

    name: str
    kind: Literal["transmission", "axis", "impedance", "callable", "linear", "mujoco", "fmu", "rig"]
    data: DataSpec = DataSpec()
    channels: dict[str, ChannelSpec] = {}
    parameters: dict[str, ParameterSpec] = {}
    link: list[LinkSpec] = []
    axis: AxisSpec | None = None
    impedance: ImpedanceSpec | None = None
    callable: CallableSpec | None = None
    linear: LinearSpec | None = None
    mujoco: MujocoSpec | None = None
    fmu: FmuSpec | None = None
    offer: list[OfferSpec] = []
    rig: RigSpec | None = None
    effect: list[EffectSpec] = []
    _folder: str = PrivateAttr(default=".")
    _files: list[Path] = PrivateAttr(default=[])

    @field_validator("parameters", mode="before")
    @classmethod
    def _a_number_is_a_value(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        return {name: {"value": value} if isinstance(value, int | float) else value for name, value in given.items()}

    @model_validator(mode="after")
    def _section_present(self) -> NominalSpec:
        section = {"transmission": "link"}.get(self.kind, self.kind)
        if not getattr(self, section):
            raise ValueError(f"kind {self.kind} needs a section [{section}]")
        if self.simulator is None:
            if self.offer:
                raise ValueError(f"[[offer]] with a kind that runs a simulator, not kind {self.kind}")
            sessions = [name for name, channel in self.channels.items() if channel.session_offset]
            tared = {link.output for link in self.link}
            alien = next((name for name in sessions if name not in tared), None)
            if alien is not None:
                raise ValueError(
                    f"session_offset ({alien}) with an output of a transmission or a kind that runs a simulator, "
                    f"not kind {self.kind}"
                )
        return self

    @property
    def simulator(self) -> SimulatorSpec | None:
        """The section of a kind that runs a simulator."""
        sections = {"callable": self.callable, "linear": self.linear, "mujoco": self.mujoco, "fmu": self.fmu}
        return sections.get(self.kind)

    @property
    def held_inputs(self) -> tuple[str, ...]:
        """Channels that the model takes for constant between samples."""
        if self.axis is not None:
            return (self.axis.input,) if self.axis.hold == "zero" else ()
        if self.linear is not None:
            return tuple(self.linear.inputs) if self.linear.hold == "zero" else ()
        return () if self.mujoco is None else tuple(self.mujoco.inputs)

    @property
    def folder(self) -> str:
        """Return the folder of the TOML file, in which its function is searched."""
        return self._folder

    @property
    def recorded_rig(self) -> bool:
        """Whether the nominal model is the rig that the recordings describe themselves."""
        return self.kind == "rig" and self.rig is not None and self.rig.recorded

    def start(self, name: str, default: float) -> tuple[float, bool]:
        """Start value of nominal parameter `name`, and whether it may be refitted."""
        given = self.parameters.get(name)
        return (given.value, given.free) if given is not None else (float(default), True)


def effect_of(text: str) -> EffectSpec:
    """An effect as written in one line, `backlash@cable:width_rad=0.02`; also `source=`, `form=` and `free=false`.
    Raises InputError.
    """
    head, _, tail = text.partition(":")
    effect_id, _, at = head.partition("@")
    content: dict[str, object] = {"id": effect_id, "at": at}
    values: dict[str, float] = {}
    for item in filter(None, tail.split(",")):
        key, _, value = item.partition("=")
        if key in ("source", "form"):
            content[key] = value
        elif key == "free":
            content[key] = value != "false"
        else:
            try:
                values[key] = float(value)
            except ValueError:
                raise InputError("--effect", item, "key=number, for example backlash@cable:width_rad=0.02") from None
    if not at:
        raise InputError("--effect", text, "id@subsystem:key=number,..., for example backlash@cable:width_rad=0.02")
    return validate(EffectSpec, {**content, "values": values})


def read_nominal(path: Path | str) -> NominalSpec:
    """The nominal model in TOML file `path`. Raises InputError naming the key."""
    path = Path(path)
    content = read_toml(path, "nominal", "a readable TOML file, or the name of one that ships")
    try:
        return nominal_of(content, path.parent)
    except InputError as error:
        raise error.in_file(path) from None


def nominal_of(content: dict[str, Any], folder: Path | str = ".") -> NominalSpec:
    """The nominal model with the content of a TOML; a callable's module is looked for in `folder`. Raises InputError."""
    spec = validate(NominalSpec, content)
    spec._folder = str(folder)
    return spec


def nominal_path(name: Path | str) -> Path:
    """The file `name`, or the nominal model of that name that ships."""
    path = Path(name)
    shipped = Path(__file__).parents[1] / "nominals" / f"{name}.toml"
    return shipped if not path.exists() and shipped.exists() else path
