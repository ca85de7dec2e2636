"""A catheter's measured and assumed parameters: read from TOML, checked, frozen."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from protocol.errors import InputError
from protocol.requests import Request, validate
from protocol.text_files import read_toml
from protocol.usual_values import CATHETER, unusual, warn_of

CATHETER_FOLDER = Path(__file__).resolve().parent / "catheters"
LENGTH_TOLERANCE_m = 1e-9

# Bounds that no catheter, sheath or guidewire reaches: beyond them a value is in another unit.
Length_m = Annotated[float, Field(ge=0.001, le=1.0)]
Diameter_m = Annotated[float, Field(ge=0.0002, le=0.02)]
Stiffness_N_m2 = Annotated[float, Field(ge=1e-7, le=1.0)]
NotNegative = Annotated[float, Field(ge=0.0)]


@dataclass(frozen=True)
class PcarParameters:
    """Planar model of chapter 2: stiffness of each arc, body first; lengths of the distal arcs, proximal first."""

    EI_N_m2: tuple[float, ...]
    distal_arcs_m: tuple[float, ...]

    @property
    def l2_m(self) -> float:
        """Length of arc 2, the first of the distal shaft (Table 2.1)."""
        return self.distal_arcs_m[0]


@dataclass(frozen=True)
class CosseratParameters:
    """Spatial model of chapter 3, all N m2: distal shaft EI1, EI2, GJ; body EbI1, EbI2, GbJ (Table 3.2)."""

    EI1: float
    EI2: float
    GJ: float
    EbI1: float
    EbI2: float
    GbJ: float


@dataclass(frozen=True)
class ConstitutiveParameters:
    """Optional terms of 8.1.1: pull-wire friction (capstan) and stiffening with curvature change."""

    friction_coefficient: float
    cubic_stiffening_m2: float


@dataclass(frozen=True)
class Catheter:
    """One type of catheter. A group of parameters is None where it has not been identified."""

    name: str
    distal_length_m: float
    diameter_m: float
    pull_wire_offset_m: float
    pcar: PcarParameters | None = None
    cosserat: CosseratParameters | None = None
    constitutive: ConstitutiveParameters | None = None


class _PcarFile(Request):
    EI_N_m2: list[Stiffness_N_m2] = Field(min_length=2)
    distal_arcs_m: list[Annotated[float, Field(gt=0.0, le=1.0)]] = Field(min_length=1)


class _CosseratFile(Request):
    EI1_N_m2: Stiffness_N_m2
    EI2_N_m2: Stiffness_N_m2
    GJ_N_m2: Stiffness_N_m2
    EbI1_N_m2: Stiffness_N_m2
    EbI2_N_m2: Stiffness_N_m2
    GbJ_N_m2: Stiffness_N_m2


class _ConstitutiveFile(Request):
    friction_coefficient: NotNegative = 0.0
    cubic_stiffening_m2: NotNegative = 0.0


class _CatheterFile(Request):
    name: str = Field(min_length=1)
    distal_length_m: Length_m
    diameter_m: Diameter_m
    pull_wire_offset_m: Annotated[float, Field(gt=0.0, le=0.01)]
    pcar: _PcarFile | None = None
    cosserat: _CosseratFile | None = None
    constitutive: _ConstitutiveFile | None = None


def shipped_catheters() -> list[str]:
    """Return the names of the catheters that come with the package."""
    return sorted(path.stem for path in CATHETER_FOLDER.glob("*.toml"))


def load_catheter(name_or_path: str | Path) -> Catheter:
    """Read a catheter's parameters.

    Parameters:
        name_or_path: the name of a catheter that ships (livewire, steerocath_t, thermocool_sf, blazer_prime_xp), or the
            path of a .toml file. Lengths in m, stiffness in N m2.

    Returns:
        Catheter: `distal_length_m`, `diameter_m`, `pull_wire_offset_m`, and the parameters of the models: `pcar`,
        `cosserat`, `constitutive`, each None where they have not been identified.

    Raises:
        InputError: an unknown name, an unreadable file, an unknown or missing key, or a value out of its range; names it.

    Warns:
        UnusualValue: a value of a file that is probably in another unit.

    Source:
        Thesis, Tables 2.1 and 3.2, for the catheters that ship; each file says where its values come from.

    Examples:
        >>> load_catheter("livewire").distal_length_m  # doctest: +SKIP
    """
    text = str(name_or_path)
    shipped = shipped_catheters()
    path = CATHETER_FOLDER / f"{text}.toml" if text in shipped else Path(text)
    if text not in shipped and path.suffix != ".toml":
        raise InputError("catheter", text, f"one of {', '.join(shipped)}, or the path of a .toml file")
    catheter = catheter_from_table(read_toml(path, "catheter", "a readable catheter TOML file"))
    if text not in shipped:
        warn_of(unusual_parameters(catheter), text)
    return catheter


def unusual_parameters(catheter: Catheter) -> list[str]:
    """Return a line for each accepted parameter that is probably in another unit, for a warning."""
    parameters = asdict(catheter)
    if catheter.cosserat is not None:
        parameters["cosserat"] = {f"{name}_N_m2": value for name, value in parameters["cosserat"].items()}
    return unusual(parameters, CATHETER)


def catheter_from_table(data: dict[str, object]) -> Catheter:
    """The catheter of one parsed TOML table. Raises InputError, naming the key."""
    file = validate(_CatheterFile, data)
    pcar = cosserat = constitutive = None
    if file.pull_wire_offset_m > 0.5 * file.diameter_m:
        raise InputError(
            "pull_wire_offset_m", file.pull_wire_offset_m, f"at most half of diameter_m, {0.5 * file.diameter_m:g}"
        )
    if file.pcar is not None:
        _check_arcs(file)
        pcar = PcarParameters(tuple(file.pcar.EI_N_m2), tuple(file.pcar.distal_arcs_m))
    if file.cosserat is not None:
        values = file.cosserat.model_dump()
        cosserat = CosseratParameters(**{key.removesuffix("_N_m2"): value for key, value in values.items()})
    if file.constitutive is not None:
        constitutive = ConstitutiveParameters(**file.constitutive.model_dump())
    return Catheter(file.name, file.distal_length_m, file.diameter_m, file.pull_wire_offset_m, pcar, cosserat, constitutive)


def _check_arcs(file: _CatheterFile) -> None:
    assert file.pcar is not None
    stiffness, arcs = file.pcar.EI_N_m2, file.pcar.distal_arcs_m
    if len(stiffness) != len(arcs) + 1:
        raise InputError("pcar.EI_N_m2", stiffness, f"{len(arcs) + 1} values: the body, then one per distal arc")
    if abs(sum(arcs) - file.distal_length_m) > LENGTH_TOLERANCE_m:
        raise InputError("pcar.distal_arcs_m", arcs, f"lengths that add up to distal_length_m {file.distal_length_m}")


def catheter_toml(catheter: Catheter, notes: list[str]) -> str:
    """`catheter` as TOML text that `load_catheter` reads back to equal values; `notes` become its head comment."""
    lines = [f"# {line}" for note in notes for line in note.splitlines()]
    lines += [f"name = {json.dumps(catheter.name, ensure_ascii=False)}".replace("\x7f", "\\u007f")]
    scalars = ("distal_length_m", "diameter_m", "pull_wire_offset_m")
    lines += [f"{key} = {getattr(catheter, key)!r}" for key in scalars]
    if catheter.pcar is not None:
        lines += [
            "",
            "[pcar]",
            f"EI_N_m2 = {list(catheter.pcar.EI_N_m2)!r}",
            f"distal_arcs_m = {list(catheter.pcar.distal_arcs_m)!r}",
        ]
    if catheter.cosserat is not None:
        lines += ["", "[cosserat]"]
        lines += [f"{key}_N_m2 = {value!r}" for key, value in vars(catheter.cosserat).items()]
    if catheter.constitutive is not None:
        lines += ["", "[constitutive]"]
        lines += [f"{key} = {value!r}" for key, value in vars(catheter.constitutive).items()]
    return "\n".join(lines) + "\n"
