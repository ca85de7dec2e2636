"""The nominal TOML: which columns are which channels, how recordings are split, and which law is taken for granted."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, Literal

from pydantic import AliasChoices, Field, PrivateAttr, model_validator

from protocol.errors import Description, InputError, reason
from protocol.requests import Request, validate


class ChannelSpec(Request):
    """One channel: SI value = sign * scale * column + offset."""

    column: str
    scale: float = 1.0
    unit: str = ""
    sign: Literal[-1, 1] = 1
    offset: float = 0.0


class SegmentSpec(Request):
    """One recording inside a file: `rows` first (inclusive) and last (exclusive)."""

    name: str
    rows: list[int] = Field(min_length=2, max_length=2)
    file: str = "*"


class DataSpec(Request):
    """Where the recordings are, their time line, and the split."""

    files: list[str] = []
    time: str | None = None
    rate_Hz: float | None = Field(default=None, gt=0)
    heldout: list[str] | None = None
    segments: list[SegmentSpec] = Field(default=[], validation_alias=AliasChoices("segments", "pieces"))
    lead_rows: int = Field(default=0, ge=0)
    by: str | None = None  # column of a file in which several recordings follow each other: a new value begins a new one


class ParameterSpec(Request):
    """A nominal parameter: start value and whether it is refitted."""

    value: float
    free: bool = True


class LinkSpec(Request):
    """One motion-in, motion-out transmission."""

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
    """

    subsystem: str = "axis"
    input: str
    output: str
    terms: list[Literal["mass", "damping", "stiffness", "offset"]] = ["mass", "damping", "offset"]
    reads: Literal["position", "velocity", "acceleration"] = "position"
    hold: Literal["zero", "linear", "band_limited"] | None = None
    controller: ControllerSpec | None = None


class ImpedanceSpec(Request):
    """Motion in, force out."""

    subsystem: str = "impedance"
    input: str
    output: str
    load: list[str] = []
    others: list[str] = []
    terms: list[Literal["mass", "damping", "stiffness", "load", "offset"]] = ["stiffness", "offset"]


class CallableSpec(Request):
    """A Python function `name(inputs, parameters, time_s) -> outputs`, dictionaries of arrays (n,)."""

    function: str
    inputs: list[str]
    outputs: list[str]
    subsystem: str = "model"
    load: list[str] = []


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
    """A whole nominal TOML."""

    name: str
    kind: Literal["transmission", "axis", "impedance", "callable", "rig"]
    data: DataSpec = DataSpec()
    channels: dict[str, ChannelSpec] = {}
    parameters: dict[str, float | ParameterSpec] = {}
    link: list[LinkSpec] = []
    axis: AxisSpec | None = None
    impedance: ImpedanceSpec | None = None
    callable: CallableSpec | None = None
    rig: RigSpec | None = None
    effect: list[EffectSpec] = []
    _folder: str = PrivateAttr(default=".")
    _files: list[Path] = PrivateAttr(default=[])

    @model_validator(mode="after")
    def _section_present(self) -> NominalSpec:
        section = {"transmission": "link"}.get(self.kind, self.kind)
        if not getattr(self, section):
            raise ValueError(f"kind {self.kind} wants a section [{section}]")
        return self

    @property
    def folder(self) -> str:
        """Where the TOML lies: its function is looked for there."""
        return self._folder

    @property
    def recorded_rig(self) -> bool:
        """Whether the nominal model is the rig that the recordings describe themselves."""
        return self.kind == "rig" and self.rig is not None and self.rig.recorded

    def start(self, name: str, default: float) -> tuple[float, bool]:
        """Start value of nominal parameter `name`, and whether it may be refitted."""
        given = self.parameters.get(name, default)
        return (given.value, given.free) if isinstance(given, ParameterSpec) else (float(given), True)


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
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            "nominal", Description(f"{path}: {reason(error)}"), "a readable TOML file, or the name of one that ships"
        ) from None
    except tomllib.TOMLDecodeError as error:
        raise InputError("nominal", Description(f"{path}: {error}"), "valid TOML") from None
    return nominal_of(content, path.parent)


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
