"""Recordings as Foxglove reads them: JSON messages under plain schemas, and channels of its own for its 3-D panel."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

from host.recordings.rig_picture import Picture
from protocol.messages import json_schema
from protocol.topics import Message

PREFIX = "foxglove/"
SCENE_EVERY_NS, POSE_EVERY_NS = 100_000_000, 50_000_000
ARROW_M_PER_N = 0.1
FRAME = "base"
_LEVELS = {"info": 2, "warning": 3, "error": 4}
Body = dict[str, Any]


def plain_schema(message_class: type[Message]) -> str:
    """Return the class' JSON Schema as Foxglove supports it: one type for each property, absent for nil."""
    schema = json.loads(json_schema(message_class))
    for name, item in schema["properties"].items():
        if name == "schema_version":
            item["type"] = "integer"
        elif isinstance(item["type"], list):
            item["type"] = item["type"][0]
            schema["required"].remove(name)
    return json.dumps(schema)


def _object(title: str, **properties: Body) -> Body:
    return {"type": "object", "title": title, "properties": properties}


def _list(item: Body) -> Body:
    return {"type": "array", "items": item}


_NUMBER, _TEXT, _FLAG, _INTEGER = ({"type": kind} for kind in ("number", "string", "boolean", "integer"))
_TIME = _object("time", sec=_INTEGER, nsec=_INTEGER)
_DURATION = _object("duration", sec=_INTEGER, nsec=_INTEGER)
_VECTOR = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_POINT = _object("foxglove.Point3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_POSE = _object(
    "foxglove.Pose", position=_VECTOR, orientation=_object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
)
_COLOR = _object("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_SPHERE = _object("foxglove.SpherePrimitive", pose=_POSE, size=_VECTOR, color=_COLOR)
_LINE = _object(
    "foxglove.LinePrimitive",
    type=_INTEGER,
    pose=_POSE,
    thickness=_NUMBER,
    scale_invariant=_FLAG,
    points=_list(_POINT),
    color=_COLOR,
    colors=_list(_COLOR),
    indices=_list(_INTEGER),
)
_NO_PRIMITIVE = _list(_object("primitive"))
_ENTITY = _object(
    "foxglove.SceneEntity",
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_DURATION,
    frame_locked=_FLAG,
    metadata=_list(_object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)),
    arrows=_NO_PRIMITIVE,
    cubes=_NO_PRIMITIVE,
    spheres=_list(_SPHERE),
    cylinders=_NO_PRIMITIVE,
    lines=_list(_LINE),
    triangles=_NO_PRIMITIVE,
    texts=_NO_PRIMITIVE,
    models=_NO_PRIMITIVE,
)

# Channel -> its schema, named as Foxglove's own documents name it.
SCHEMAS: dict[str, Body] = {
    PREFIX + "tip": _object("foxglove.PoseInFrame", timestamp=_TIME, frame_id=_TEXT, pose=_POSE),
    PREFIX + "scene": _object(
        "foxglove.SceneUpdate", deletions=_list(_object("foxglove.SceneEntityDeletion", id=_TEXT)), entities=_list(_ENTITY)
    ),
    PREFIX + "log": _object(
        "foxglove.Log", timestamp=_TIME, level=_INTEGER, message=_TEXT, name=_TEXT, file=_TEXT, line=_INTEGER
    ),
}


class Derived(NamedTuple):
    """One message of a channel of Foxglove's own."""

    topic: str
    stamp_ns: int
    body: Body


class FoxgloveChannels:
    """Makes the messages of `SCHEMAS` out of the rig's own: tip at 20 Hz, scene at 10 Hz, every line of the log.

    configuration, catheter: as in the recording's header; the scene lacks the catheter where they say too little.
    """

    def __init__(self, configuration: Mapping[str, Any], catheter: Mapping[str, Any]) -> None:
        self._picture = Picture(configuration, catheter)
        self._due_ns = {name: 0 for name in ("scene", "tip")}

    def derive(self, topic: str, body: Body) -> list[Derived]:
        """Take in one message as a dict; what is due because of it."""
        if topic == "log":
            return [
                Derived(
                    PREFIX + "log",
                    body["stamp_ns"],
                    {
                        "timestamp": _time(body["stamp_ns"]),
                        "level": _LEVELS[body["level"]],
                        "message": body["text"],
                        "name": body["source"],
                        "file": "",
                        "line": 0,
                    },
                )
            ]
        self._picture.take(topic, body)
        if topic == "pose/tip" and body.get("position_m") is not None and self._due("tip", body["stamp_ns"], POSE_EVERY_NS):
            return [
                Derived(
                    PREFIX + "tip",
                    body["stamp_ns"],
                    {
                        "timestamp": _time(body["stamp_ns"]),
                        "frame_id": FRAME,
                        "pose": _pose(body["position_m"], body["quaternion_wxyz"]),
                    },
                )
            ]
        if topic == "state" and self._due("scene", body["stamp_ns"], SCENE_EVERY_NS):
            return [self._scene(body["stamp_ns"])]
        return []

    def _due(self, name: str, stamp_ns: int, every_ns: int) -> bool:
        if stamp_ns < self._due_ns[name] <= stamp_ns + every_ns:
            return False
        self._due_ns[name] = stamp_ns + every_ns
        return True

    def _scene(self, stamp_ns: int) -> Derived:
        seen = self._picture.scene()
        shape, tip, force = seen["shape_m"], seen["tip_m"], seen["force_N"]
        lines = [] if shape is None else [_line(shape, 4.0, (0.20, 0.45, 0.85))]
        if tip is not None and force is not None:
            end = [place + ARROW_M_PER_N * part for place, part in zip(tip, force, strict=True)]
            lines.append(_line([tip, end], 5.0, (0.95, 0.55, 0.10)))
        spheres = [] if seen["target_m"] is None else [_sphere(seen["target_m"], 0.0015, (0.15, 0.70, 0.45))]
        entity = {
            "timestamp": _time(stamp_ns),
            "frame_id": FRAME,
            "id": "rig",
            "lifetime": _time(0),
            "frame_locked": False,
            "metadata": [],
            "arrows": [],
            "cubes": [],
            "spheres": spheres,
            "cylinders": [],
            "lines": lines,
            "triangles": [],
            "texts": [],
            "models": [],
        }
        return Derived(PREFIX + "scene", stamp_ns, {"deletions": [], "entities": [entity]})


def _time(stamp_ns: int) -> Body:
    return {"sec": stamp_ns // 1_000_000_000, "nsec": stamp_ns % 1_000_000_000}


def _xyz(place: Any) -> Body:
    return {axis: round(float(value), 6) for axis, value in zip("xyz", place, strict=True)}


def _pose(position_m: Any = (0.0, 0.0, 0.0), quaternion_wxyz: Any = (1.0, 0.0, 0.0, 0.0)) -> Body:
    w, x, y, z = (round(float(value), 6) for value in quaternion_wxyz)
    return {"position": _xyz(position_m), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def _color(rgb: tuple[float, float, float]) -> Body:
    return {"r": rgb[0], "g": rgb[1], "b": rgb[2], "a": 1.0}


def _line(points: Any, thickness_px: float, rgb: tuple[float, float, float]) -> Body:
    return {
        "type": 0,
        "pose": _pose(),
        "thickness": thickness_px,
        "scale_invariant": True,
        "points": [_xyz(point) for point in points],
        "color": _color(rgb),
        "colors": [],
        "indices": [],
    }


def _sphere(place: Any, size_m: float, rgb: tuple[float, float, float]) -> Body:
    return {"pose": _pose(place), "size": _xyz([size_m] * 3), "color": _color(rgb)}
