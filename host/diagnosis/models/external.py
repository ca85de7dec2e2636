"""A Python function as nominal model: `name(inputs, parameters, time_s)` or, with the initial state, a fourth argument."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_all_start_methods, get_context
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.model.model import Segment
from host.diagnosis.model.nominal import NominalSpec
from host.diagnosis.models.simulated import FailedRun, SimulatedModel, SimulatorRun, attempted
from protocol.errors import InputError
from protocol.worker_process import end_with_parent

Array = npt.NDArray[np.float64]
Function = Callable[..., Mapping[str, Array]]


class ExternalModel(SimulatedModel):
    """Nominal model of kind `callable`. The same arguments have to give the same outputs: they are kept."""

    kind = "callable"

    def __init__(self, spec: NominalSpec) -> None:
        if spec.callable is None:
            raise ValueError("callable: found nothing, wanted a section")
        self.spec, self.folder = spec.callable, spec.folder
        self.function: Function = (
            function_of(self.spec.function, spec.folder) if isinstance(self.spec.function, str) else self.spec.function
        )
        self.takes_initial = arguments_of(self.function) > 3
        super().__init__(spec, spec.callable, spec.offer)
        self.offs = {offer.parameter: offer.off for offer in spec.offer}
        self._pool: Executor | None = None
        if self.spec.workers > 1:
            # Forked workers have the function without importing it; elsewhere threads serve what frees the interpreter.
            self._pool = (
                ProcessPoolExecutor(self.spec.workers, get_context("fork"), _begin_worker, (self.function,))
                if "fork" in get_all_start_methods()
                else ThreadPoolExecutor(self.spec.workers)
            )

    @property
    def label(self) -> str:
        """Return the name of the function."""
        return self.spec.function if isinstance(self.spec.function, str) else getattr(self.function, "__name__", "function")

    def initial_state(self, segment: Segment) -> tuple[list[str], list[float], list[float]]:
        """Return the initial state as for every simulator; nothing for a function of three arguments."""
        return super().initial_state(segment) if self.takes_initial else ([], [], [])

    def run(
        self, inputs: dict[str, Array], parameters: dict[str, float], time_s: Array, initial: dict[str, float]
    ) -> Mapping[str, Array]:
        """Call the function; offered parameters that are off are given with their nominal value."""
        return self.function(*self._arguments(SimulatorRun(inputs, parameters, time_s, initial)))

    def run_many(self, runs: list[SimulatorRun]) -> list[Array]:
        """Outputs of each of `runs`, in parallel where the file says that the function can."""
        if self._pool is None or len(runs) < 2:
            return super().run_many(runs)
        call = _call_in_worker if isinstance(self._pool, ProcessPoolExecutor) else self._attempt
        arguments = [self._arguments(run) for run in runs]
        return [self._checked(run, found) for run, found in zip(runs, self._pool.map(call, arguments), strict=True)]

    def _arguments(self, run: SimulatorRun) -> tuple[Any, ...]:
        given = (run.inputs, {**self.offs, **run.parameters}, run.time_s)
        return (*given, run.initial) if self.takes_initial else given

    def _attempt(self, arguments: tuple[Any, ...]) -> Mapping[str, Array] | FailedRun:
        return attempted(self.function, *arguments)


_in_worker: list[Function] = []  # the function of a worker process


def _begin_worker(function: Function) -> None:
    end_with_parent()
    _in_worker[:] = [function]


def _call_in_worker(arguments: tuple[Any, ...]) -> Mapping[str, Array] | FailedRun:
    found = attempted(_in_worker[0], *arguments)
    return found if isinstance(found, FailedRun) else {n: np.asarray(row, dtype=np.float64) for n, row in found.items()}


def arguments_of(function: Function) -> int:
    """Number of positional arguments that `function` takes."""
    try:
        kinds = [p.kind for p in inspect.signature(function).parameters.values()]
    except (TypeError, ValueError):
        return 3
    return sum(kind in (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD) for kind in kinds)


def function_of(text: str, folder: str) -> Function:
    """The function that `text` (module:name) stands for. Raises InputError.

    A module in `folder` comes first and has a name of its own in the interpreter: two folders may hold modules of one
    name.
    """
    module, _, name = text.partition(":")
    path = module_path(module, folder)
    sys.path.insert(0, folder)
    try:
        found: Any = getattr(_loaded(path) if path is not None else importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError, SyntaxError) as error:
        raise InputError("callable.function", f"{text} ({error})", "module:name of a Python function") from None
    finally:
        sys.path.remove(folder)
    if not callable(found):
        raise InputError("callable.function", text, "module:name of a Python function")
    return found  # type: ignore[no-any-return]


def module_path(module: str, folder: str) -> Path | None:
    """The file of `module` in `folder`; None if it is installed elsewhere."""
    path = Path(folder, *module.split(".")).with_suffix(".py")
    return path if module and path.is_file() else None


def _loaded(path: Path) -> Any:
    key = f"nominal_{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:12]}_{path.stem}"
    found = importlib.util.spec_from_file_location(key, path)
    assert found is not None and found.loader is not None
    module = importlib.util.module_from_spec(found)
    sys.modules[key] = module
    found.loader.exec_module(module)
    return module
