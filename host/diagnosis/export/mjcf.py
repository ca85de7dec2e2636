"""The nominal MuJoCo file with the parameters that a diagnosis found: an MJCF file that MuJoCo loads by itself.

The text of the nominal file is kept, comments included, and attributes are written in it with all digits (MuJoCo's own
writer rounds to six). Included files are put in their place. The file is read back: it has to hold the parameters, and a
run of it has to equal the finder's simulation.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np
import numpy.typing as npt

from host.diagnosis.export.module import extended
from host.diagnosis.export.parameters import parameter_values
from host.diagnosis.models.mjcf import PAYLOAD_INERTIA_KG_M2, MujocoModel, carrier, one_line, place, rolled, specified
from host.diagnosis.pipeline import Diagnosis
from protocol.errors import Description, InputError

Array = npt.NDArray[np.float64]
EQUAL = 1e-9  # difference of a run of the written file from the finder's simulation, relative
SECTIONS = {
    "joint": ("worldbody", ("joint", "freejoint")),
    "body": ("worldbody", ("body",)),
    "geom": ("worldbody", ("geom",)),
    "site": ("worldbody", ("site",)),
    "tendon": ("tendon", ("spatial", "fixed")),
    "actuator": ("actuator", None),
}
FOLDERS = ("meshdir", "texturedir", "assetdir")


def mjcf_of(result: Diagnosis, path: Path) -> str:
    """Text of the nominal model file with every fitted parameter, for a file at `path`.

    Raises:
        InputError: another kind, an effect that no parameter of the simulator stands for, or a parameter that the file
            format cannot express.
    """
    model = result.model.inner
    if not isinstance(model, MujocoModel):
        raise InputError("--export", f"kind {model.kind}", "kind mujoco, for a file ending in .xml")
    values = parameter_values(result)
    root = _parsed(model.path)
    _keep_assets(root, model.path.parent.resolve(), path.parent.resolve())
    for name, value in values.items():
        _write(root, model, name, value)
    words = ", ".join(f"{name} = {value:.6g}" for name, value in values.items())
    root.insert(0, ET.Comment(f" {model.path.name} with parameters that a diagnosis found: {words} ".replace("--", "- -")))
    ET.indent(root)
    text = ET.tostring(root, encoding="unicode") + "\n"
    _check(result, model, text, path, values)
    return text


def _parsed(path: Path) -> ET.Element:
    """Root element of the file, comments kept, included files in their place. Raises InputError."""
    try:
        root = ET.parse(path, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))).getroot()
    except (OSError, ET.ParseError) as error:
        raise InputError("--export", Description(f"{path}: {error}"), "a model file in XML") from None
    for parent in list(root.iter()):
        for at, child in reversed(list(enumerate(parent))):
            if child.tag == "include":
                parent.remove(child)
                for part in reversed(list(_parsed(path.parent / child.get("file", "")))):
                    parent.insert(at, part)
    return root


def _keep_assets(root: ET.Element, source: Path, target: Path) -> None:
    """Let meshes, textures and height fields be found from another folder."""
    if source == target or not any(one.get("file") for one in root.iter()):
        return
    compilers = [one for one in root.iter("compiler") if any(one.get(key) for key in FOLDERS)]
    for one in compilers:
        for key in FOLDERS:
            if one.get(key):
                one.set(key, str(source / one.get(key, "")))
    if not compilers:
        root.insert(0, ET.Element("compiler", {"assetdir": str(source)}))


def _write(root: ET.Element, model: MujocoModel, name: str, value: float) -> None:
    """Set parameter `name` (element.attribute) in the file."""
    element, _, attribute = name.rpartition(".")
    if attribute == "payload":
        body, at = carrier(model.path, specified(model.path, {}), element)
        load = ET.SubElement(_found(root, "body", body.name), "body", {"name": f"{element}_payload", "pos": _text(at)})
        _inertial(load, np.zeros(3), value, np.full(3, PAYLOAD_INERTIA_KG_M2))
        return
    kind, array = _compiled(model.mjcf, element, attribute)
    node = _found(root, kind, element)
    if kind == "body" and attribute == "mass":
        body = model.mjcf.body(element)
        for old in node.findall("inertial"):
            node.remove(old)
        _inertial(node, body.ipos, value, body.inertia, body.iquat)
        return
    numbers = array.copy()
    numbers[0] = value
    node.set(attribute, _text(numbers))


def _inertial(body: ET.Element, place_m: Array, mass: float, inertia: Array, turn: Array | None = None) -> None:
    given = {"pos": _text(place_m), "mass": repr(float(mass)), "diaginertia": _text(inertia)}
    if turn is not None:
        given["quat"] = _text(turn)
    body.append(ET.Element("inertial", given))


def _compiled(model: Any, element: str, attribute: str) -> tuple[str, Array]:
    """Kind of the element, and what the compiled model has of its attribute."""
    for kind in SECTIONS:
        try:
            return kind, np.ravel(np.array(getattr(getattr(model, kind)(element), attribute), dtype=np.float64))
        except (KeyError, AttributeError):
            continue
    raise InputError("--export", f"{element}.{attribute}", "a parameter that the model file has")


def _found(root: ET.Element, kind: str, name: str) -> ET.Element:
    section, tags = SECTIONS[kind]
    for node in _inside(root, section):
        if node.get("name") == name and (tags is None or node.tag in tags):
            return node
    wanted = "an element that stands in the file by its name (not one that <replicate> or <attach> makes)"
    raise InputError("--export", f"{kind} {name}", wanted)


def _inside(root: ET.Element, section: str) -> Iterator[ET.Element]:
    for part in root.iter(section):
        yield from part.iter()


def _text(numbers: Any) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(numbers))


def _check(result: Diagnosis, model: MujocoModel, text: str, path: Path, values: dict[str, float]) -> None:
    """Read the file back: every parameter, and a run of the first recording. Raises InputError where one differs."""
    import mujoco

    with NamedTemporaryFile("w", suffix=".xml", dir=path.parent, encoding="utf-8") as file:
        file.write(text)
        file.flush()
        try:
            written = mujoco.MjModel.from_xml_path(file.name)
        except ValueError as error:
            raise InputError("--export", Description(one_line(error)), "parameters that MJCF has as attributes") from None
    for name, value in values.items():
        array, index = place(written, name)
        if abs(float(array[index]) - value) > EQUAL * abs(value):
            raise InputError("--export", f"{name}, which the model file does not keep", "an attribute of MJCF")
    run = model.run_of(result.problem.segments[0], *extended(result))
    mine = model.run(run.inputs, run.parameters, run.time_s, run.initial)
    its = rolled(written, (model.controls, model.readings), model.steps_s, run.inputs, run.time_s, run.initial)
    for channel, row in mine.items():
        if not np.max(np.abs(its[channel] - row)) <= EQUAL * max(float(np.max(np.abs(row))), 1e-300):
            raise InputError("--export", f"{channel} of the written file differs from the simulation", "attributes of MJCF")
