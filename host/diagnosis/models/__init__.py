"""Nominal models, one file a kind; `build` makes the one a TOML asks for, `channels_of` says what it reads."""

from __future__ import annotations

from host.diagnosis.model.model import Model
from host.diagnosis.model.nominal import ChannelSpec, NominalSpec
from protocol.errors import InputError

LAW = ("mass", "damping", "stiffness", "offset")  # names that an axis and an impedance know; one that `terms` lacks is zero


def build(spec: NominalSpec) -> Model:
    """The nominal model of `spec`; the rig that recordings describe themselves is `live.recorded_rig`.

    Raises:
        InputError: a section that is not usable, or a parameter that the model does not have.
    """
    model = _built(spec)
    if spec.simulator is None:  # a simulator looks up the names itself
        from host.diagnosis.models.rig import KEYS

        own = [KEYS.get(p.name, p.name) if spec.kind == "rig" else p.name for p in model.parameters]
        accepted = dict.fromkeys([*own, *(LAW if spec.kind in ("axis", "impedance") else ())])
        for name, parameter in spec.parameters.items():
            if name not in accepted:
                raise InputError(f"parameters.{name}", f"no parameter of kind {spec.kind}", "one of " + ", ".join(accepted))
            if name not in own and parameter.value != 0.0:
                wanted = f"0, or {name} in {spec.kind}.terms, without which the law has none"
                raise InputError(f"parameters.{name}", parameter.value, wanted)
    return model


def _built(spec: NominalSpec) -> Model:
    if spec.kind == "transmission":
        from host.diagnosis.models.transmission import TransmissionModel

        return TransmissionModel(spec)
    if spec.kind == "impedance":
        from host.diagnosis.models.impedance import ImpedanceModel

        return ImpedanceModel(spec)
    if spec.kind == "axis":
        from host.diagnosis.models.axis import AxisModel

        return AxisModel(spec)
    if spec.kind == "rig":
        from host.diagnosis.models.rig import RigModel

        return RigModel(spec)
    if spec.kind == "linear":
        from host.diagnosis.models.linear import LinearModel

        return LinearModel(spec)
    if spec.kind == "mujoco":
        from host.diagnosis.models.mjcf import MujocoModel

        return MujocoModel(spec)
    if spec.kind == "fmu":
        from host.diagnosis.models.fmu import FmuModel

        return FmuModel(spec)
    from host.diagnosis.models.external import ExternalModel

    return ExternalModel(spec)


def channels_of(spec: NominalSpec) -> tuple[dict[str, ChannelSpec], set[str]]:
    """Channels the model reads, and which of them may be absent. Raises InputError where one is not declared."""
    if spec.kind == "rig":
        from host.diagnosis.models.rig import rig_channels

        return rig_channels(spec)
    names: list[str] = []
    optional: set[str] = set()
    for link in spec.link:
        names += [link.input, link.output, *link.load, *link.others]
    if spec.axis is not None:
        names += [spec.axis.input, spec.axis.output]
        if spec.axis.controller is not None:
            names += [spec.axis.controller.reference]
            if spec.axis.controller.added:
                names.append(spec.axis.controller.added)
                optional.add(spec.axis.controller.added)
    if spec.impedance is not None:
        names += [spec.impedance.input, spec.impedance.output, *spec.impedance.load, *spec.impedance.others]
    if spec.simulator is not None:
        names += [*spec.simulator.inputs, *spec.simulator.outputs, *spec.simulator.load]
    for name in names:
        if name not in spec.channels:
            raise InputError(name, "no such channel", "one of [channels]: " + ", ".join(spec.channels))
    return {name: spec.channels[name] for name in dict.fromkeys(names)}, optional
