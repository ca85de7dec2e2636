"""A functional mock-up unit (FMI 2.0 or 3.0, co-simulation) as nominal model, by the names of its variables."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from weakref import finalize

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.model import Segment
from host.diagnosis.model.nominal import NominalSpec
from host.diagnosis.models.simulated import SimulatedModel
from protocol.errors import Description, InputError

Array = npt.NDArray[np.float64]
REAL = ("Real", "Float64")
VERSIONS = ("2.0", "3.0")


class FmuModel(SimulatedModel):
    """Nominal model of kind `fmu`.

    Inputs are held between samples, and one communication step is one sample. Outputs are read after the inputs of their
    sample are set, so that an output that answers at once is not a sample late. Parameters are set before initialization.
    """

    kind = "fmu"

    def __init__(self, spec: NominalSpec) -> None:
        if spec.fmu is None:
            raise ValueError("fmu: found nothing, wanted a section")
        self.spec = spec.fmu
        self.path = Path(spec.folder, self.spec.model)
        self.description, folder = opened(self.path)
        self._unpacked = finalize(self, shutil.rmtree, folder, True)
        self.folder = folder
        self.real = {v.name: v for v in self.description.modelVariables if v.type in REAL and not v.dimensions}
        self.offs = {offer.parameter: offer.off for offer in spec.offer}
        for name in (*spec.parameters, *self.offs):
            self._reference(name, "parameters", ("parameter", "structuralParameter"))
        super().__init__(spec, self.spec, spec.offer)
        names = self.spec.variables
        self.controls = [self._reference(names.get(channel, channel), "inputs", ("input",)) for channel in self.spec.inputs]
        self.readings = [self._reference(names.get(channel, channel), "outputs", ()) for channel in self.spec.outputs]
        self.begins = {state: self._reference(name, "initial", ()) for state, name in self.spec.initial.items()}
        self._instance: Any = self._instantiated()

    @property
    def label(self) -> str:
        """Return the name of the FMU file."""
        return self.path.name

    def _reference(self, name: str, key: str, causalities: tuple[str, ...]) -> int:
        """Value reference of variable `name`. Raises InputError if no variable has one of these causalities."""
        if name not in self.real:
            near = ", ".join(sorted(n for n, v in self.real.items() if not causalities or v.causality in causalities))
            raise InputError(f"fmu.{key}", name, f"a variable of {self.path.name}: {near or 'it has none of this kind'}")
        variable = self.real[name]
        if causalities and variable.causality not in causalities:
            found = Description(f"{name}, which is {variable.causality}")
            raise InputError(f"fmu.{key}", found, f"a variable of causality {causalities[0]}")
        return int(variable.valueReference)

    def initial_state(self, segment: Segment) -> tuple[list[str], list[float], list[float]]:
        """Those states that the file names a variable for under `initial`; others start as the unit has them."""
        every = zip(*super().initial_state(segment), strict=True)
        kept = [one for one in every if one[0] in self.begins]
        return [one[0] for one in kept], [one[1] for one in kept], [one[2] for one in kept]

    def run(
        self, inputs: dict[str, Array], parameters: dict[str, float], time_s: Array, initial: dict[str, float]
    ) -> Mapping[str, Array]:
        """Simulate; from the sample on at which the unit fails, outputs are NaN."""
        from fmpy.fmi1 import FMICallException

        rows = np.full((len(self.readings), time_s.size), np.nan)
        given = np.vstack([np.zeros((0, time_s.size)), *(inputs[name] for name in self.spec.inputs)])
        try:
            unit = self._begun({**self.offs, **parameters}, initial, float(time_s[0]))
            self._step_through(unit, given, time_s, rows)
            unit.terminate()
        except FMICallException:
            self._drop()
        return dict(zip(self.spec.outputs, rows, strict=True))

    def _step_through(self, unit: Any, given: Array, time_s: Array, rows: Array) -> None:
        fmi2 = self.description.fmiVersion == "2.0"
        write, read = (unit.setReal, unit.getReal) if fmi2 else (unit.setFloat64, unit.getFloat64)
        for k in range(time_s.size):
            if self.controls:
                write(self.controls, given[:, k].tolist())
            rows[:, k] = read(self.readings)
            if k + 1 < time_s.size:
                now = float(time_s[k])
                unit.doStep(currentCommunicationPoint=now, communicationStepSize=float(time_s[k + 1]) - now)

    def _begun(self, parameters: dict[str, float], initial: dict[str, float], start_s: float) -> Any:
        """The unit, reset and initialized with these parameters and states."""
        if self._instance is None:
            self._instance = self._instantiated()
        else:
            self._instance.reset()
        unit, fmi2 = self._instance, self.description.fmiVersion == "2.0"
        references = [int(self.real[name].valueReference) for name in parameters]
        values = [float(value) for value in parameters.values()]
        references += [self.begins[name] for name in initial]
        values += [float(value) for value in initial.values()]
        if fmi2:
            unit.setupExperiment(startTime=start_s)
        if references:
            (unit.setReal if fmi2 else unit.setFloat64)(references, values)
        if fmi2:
            unit.enterInitializationMode()
        else:
            unit.enterInitializationMode(startTime=start_s)
        unit.exitInitializationMode()
        return unit

    def _instantiated(self) -> Any:
        """An instance of the unit. Raises InputError where its library does not load or refuses."""
        from fmpy import instantiate_fmu

        try:
            return instantiate_fmu(self.folder, self.description, "CoSimulation")
        except Exception as error:  # ctypes and FMPy raise several types
            found = Description(f"{self.path}: {' '.join(str(error).split())[:200]}")
            raise InputError("fmu.model", found, "a unit that can be instantiated") from None

    def _drop(self) -> None:
        """Give up an instance that failed: its state is not defined."""
        if self._instance is not None:
            self._instance.freeInstance()
        self._instance = None


def opened(path: Path) -> tuple[Any, str]:
    """Model description of the unit at `path`, and the folder that it was unpacked into. Raises InputError."""
    from fmpy import extract, platform, read_model_description, supported_platforms

    try:
        description = read_model_description(str(path))
        wanted = "an FMU for co-simulation, of FMI " + " or ".join(VERSIONS)
        if description.fmiVersion not in VERSIONS or description.coSimulation is None:
            kind = "without co-simulation" if description.coSimulation is None else f"of FMI {description.fmiVersion}"
            raise InputError("fmu.model", Description(f"{path} {kind}"), wanted)
        if platform not in supported_platforms(str(path)):
            found = Description(f"{path} for {', '.join(supported_platforms(str(path))) or 'no platform'}")
            raise InputError("fmu.model", found, f"an FMU with a library for {platform}")
        return description, extract(str(path))
    except InputError:
        raise
    except Exception as error:  # FMPy raises whatever zip, XML and schema raise
        found = Description(f"{path}: {' '.join(str(error).split())[:200]}")
        raise InputError("fmu.model", found, "a readable FMU (FMI 2.0 or 3.0)") from None
