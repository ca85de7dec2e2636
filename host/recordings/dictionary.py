"""The data dictionary of recordings: every column of every topic with its unit, its frame, and whose force or pose it is.

`python -m host.recordings.dictionary` prints the tables of docs/recordings.md from the declarations of the messages. What
those do not say, frame and owner, is stated below once for each field that has a direction or a place in space.
"""

from __future__ import annotations

from typing import NamedTuple

from protocol.messages import columns, specs
from protocol.topics import TOPICS, Topic


class Meaning(NamedTuple):
    """frame: in which the numbers are given. whose: what it belongs to, and on what a force acts."""

    frame: str
    whose: str


HANDLE = "axis of the stage, at the handle"
BASE = "base"
ON_TISSUE = "of the tip on the tissue"
# (topic, field) -> frame and owner. A test checks that every field in space is here, and no other.
MEANINGS: dict[tuple[str, str], Meaning] = {
    **{("stage", f"command_{name}"): Meaning(HANDLE, "commanded") for name in ("insertion_m", "roll_rad", "knob_rad")},
    **{("stage", f"encoder_{name}"): Meaning(HANDLE, "measured") for name in ("insertion_m", "roll_rad", "knob_rad")},
    ("stage", "joint_insertion_m"): Meaning("axis of the sheath, at its exit", "controller's estimate"),
    ("stage", "joint_roll_rad"): Meaning("about e3 of the base, at the sheath's exit", "controller's estimate"),
    ("stage", "joint_curvature_per_m"): Meaning("bending plane after roll", "controller's estimate, without load"),
    ("pose/tip", "position_m"): Meaning(BASE, "sensor at the tip, measured"),
    ("pose/tip", "quaternion_wxyz"): Meaning("sensor to base", "sensor at the tip, measured"),
    ("pose/shaft", "position_m"): Meaning(BASE, "sensor on the shaft, measured"),
    ("pose/shaft", "quaternion_wxyz"): Meaning("sensor to base", "sensor on the shaft, measured"),
    ("pose/rear", "position_m"): Meaning(BASE, "third sensor, behind the shaft's, measured"),
    ("pose/rear", "quaternion_wxyz"): Meaning("sensor to base", "third sensor, behind the shaft's, measured"),
    ("force/sensor", "force_N"): Meaning(BASE, f"{ON_TISSUE}, measured; the tissue's force on the tip is its negative"),
    ("force/sensor", "torque_Nm"): Meaning(BASE, "on the tissue, measured at the sensor's origin"),
    ("force/estimate", "force_N"): Meaning("column frame", f"{ON_TISSUE}, estimated from poses"),
    ("force/estimate", "covariance_N2"): Meaning("column frame", "of the estimate"),
    ("force/estimate", "lasting_covariance_N2"): Meaning("column frame", "of the estimate"),
    ("force/estimate", "nominal_force_N"): Meaning("column frame", f"{ON_TISSUE}, estimated with the file's stiffness"),
    ("force/estimate", "nominal_covariance_N2"): Meaning("column frame", "of that estimate"),
    ("contact", "body_offset_m"): Meaning("arc length, back from the tip", "contact of the body, estimated"),
    ("contact", "body_offset_sd_m"): Meaning("arc length", "of that estimate"),
    ("contact", "body_force_N"): Meaning(BASE, "of the body on the touched object, estimated"),
    ("contact", "body_covariance_N2"): Meaning(BASE, "of that estimate"),
    ("contact", "tip_force_N"): Meaning(BASE, f"{ON_TISSUE}, estimated together with that of the body"),
    ("contact", "tip_covariance_N2"): Meaning(BASE, "of that estimate"),
    ("state", "tip_m"): Meaning(BASE, "tip as estimated by the controller"),
    ("state", "target_m"): Meaning(BASE, "commanded point"),
    ("state", "tip_velocity_m_per_s"): Meaning(BASE, "tip as estimated by the controller"),
    ("state", "force_direction"): Meaning(BASE, "unit vector into the tissue, commanded"),
    ("state", "force_N"): Meaning("along force_direction", f"{ON_TISSUE}, as the controller uses it"),
    ("state", "target_force_N"): Meaning("along force_direction", f"{ON_TISSUE}, commanded"),
    ("command", "target_m"): Meaning(BASE, "commanded point"),
    ("command", "normal"): Meaning(BASE, "unit vector into the tissue, commanded"),
    ("command", "force_N"): Meaning("along the normal", f"{ON_TISSUE}, commanded"),
    ("command", "direction"): Meaning(BASE, "unit vector of a jog of the tip"),
    ("plan", "load_N"): Meaning("in the bending plane", "of the puncture on the catheter, planned"),
    ("plan", "contact_force_N"): Meaning(BASE, f"{ON_TISSUE}, planned"),
    ("plan", "shape_m"): Meaning(BASE, "centre line of the catheter, planned"),
    ("sim/truth", "tip_m"): Meaning(BASE, "tip, true"),
    ("sim/truth", "wall_m"): Meaning(BASE, "point of the wall, true"),
    ("sim/truth", "contact_force_N"): Meaning(BASE, f"{ON_TISSUE}, true"),
    ("sim/truth", "distal_insertion_m"): Meaning("axis of the sheath, at its exit", "distal end, true"),
    ("sim/truth", "distal_roll_rad"): Meaning("about e3 of the base, at the sheath's exit", "distal end, true"),
    ("sim/truth", "distal_curvature_per_m"): Meaning("bending plane after roll", "distal end, true, without load"),
}
# Units of what has a place, a direction or a force; and fields with these units that have none.
SPATIAL_UNITS = ("m", "m/s", "rad", "1/m", "N", "N m", "N^2")
WITHOUT_FRAME = {(f"pose/{name}", "quality_m") for name in ("tip", "shaft", "rear")}


def recorded_topics() -> list[Topic]:
    """The topics that a recording can have: all that are published, not the queries."""
    return [topic for topic in TOPICS.values() if topic.kind != "query"]


def as_markdown() -> str:
    """Return the tables of docs/recordings.md: one for each topic, a row for each column of its table."""
    lines: list[str] = []
    for topic in recorded_topics():
        rate = f"{topic.rate_hz:g} Hz" if topic.rate_hz else "at each event"
        lines += ["", f"### `{topic.name}`", "", f"{_sentence(topic.doc)} {rate[0].upper()}{rate[1:]}.", ""]
        lines += ["| column | unit | frame | whose | what |", "|---|---|---|---|---|"]
        names = {column: field for field, spec in specs(topic.message).items() for column in spec.columns or (field,)}
        histogram = [column for column in names if column.startswith("tick_bucket_")]
        for column, spec in columns(topic.message).items():
            if column in histogram[1:]:
                continue
            meaning = MEANINGS.get((topic.name, names[column]), Meaning("-", "-"))
            shown = f"`{column}`" if column not in histogram else f"`{column}` to `{histogram[-1]}`"
            what = spec.doc + (", empty if not known" if spec.optional else "")
            lines.append(f"| {shown} | {spec.unit or '-'} | {meaning.frame} | {meaning.whose} | {what} |")
        lines.append("| `recorded_ns` | ns | - | - | time at which the recorder received the message, on the rig's clock |")
    return "\n".join(lines[1:]) + "\n"


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


if __name__ == "__main__":
    print(as_markdown(), end="")
