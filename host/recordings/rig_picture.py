"""The rig as it is now, gathered from its messages: the content of one frame for the page, and of the 3-D scene."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from protocol.enums import BoardState

# Samples of a trace that wait for the next frame: a third of a second of live ones, or what fills a trace after a jump.
WAITING = 512
LOG_LINES = 6
# Kept for a page that is opened later: every third sample of the last half minute.
KEPT, KEEP_EVERY = 1000, 3
# An estimate older than this is not a measure of the present force.
ESTIMATE_LASTS_NS = 200_000_000
# A pose this old is not drawn as where the sensor is.
POSE_LASTS_NS = 500_000_000
# A plan of which nothing was published for so long is no longer carried out: its program was ended.
PLAN_LASTS_NS = 30_000_000_000
Body = Mapping[str, Any]


class Picture:
    """Newest messages of each topic, and the samples of the traces since the last frame.

    configuration, catheter: as in a recording's header (`Rig.effective`, `dataclasses.asdict` of a catheter).
    Time in frames is seconds of the rig's clock.
    """

    def __init__(self, configuration: Body, catheter: Body) -> None:
        self._configuration = configuration
        self._shape = _shape_of(catheter) if catheter else None
        self._newest: dict[str, Body] = {}
        self._force_rows: deque[list[float | None]] = deque(maxlen=WAITING)
        self._estimate_rows: deque[list[float | None]] = deque(maxlen=WAITING)
        self._kept: dict[str, deque[list[float | None]]] = {name: deque(maxlen=KEPT) for name in ("rows", "estimates")}
        self._received = 0
        self._plan: dict[str, Any] | None = None
        self._log: deque[dict[str, Any]] = deque(maxlen=LOG_LINES)
        self._log_new = False
        self.now_ns = 0

    def clear(self) -> None:
        """Forget all messages, for a jump in time."""
        self._newest.clear()
        self._plan = None
        self._log.clear()
        for rows in (self._force_rows, self._estimate_rows, *self._kept.values()):
            rows.clear()
        self.now_ns, self._log_new = 0, True

    def take(self, topic: str, body: Body) -> None:
        """Take in one message as a dict; a missing key counts as nil. Topics of no concern cost nothing."""
        if topic.startswith("pose/") and body.get("position_m") is None:
            return  # not seen this time: the one before stands until it is old
        self._newest[topic] = body
        if topic == "state":
            self.now_ns = body["stamp_ns"]
            # Before the first pose the loop's prediction is where it was switched on: nothing that is known.
            tip = (body.get("tip_m") if "pose/tip" in self._newest else None) or (None,) * 3
            target = body.get("target_m") or (None,) * 3
            self._force_rows.append(
                [
                    _seconds(body["stamp_ns"]),
                    _rounded(body.get("force_N"), 5),
                    _rounded(body.get("target_force_N"), 5),
                    *(_rounded(value, 6) for value in (*tip, *target)),
                ]
            )
            self._received += 1
            if self._received % KEEP_EVERY == 0:
                self._kept["rows"].append(self._force_rows[-1])
        elif topic == "force/estimate":
            self._estimate_rows.append([_seconds(body["stamp_ns"]), *self._along(body)])
            self._kept["estimates"].append(self._estimate_rows[-1])
        elif topic == "plan":
            self._take_planned(body)
        elif topic == "log":
            self._log.append({"t": _seconds(body["stamp_ns"]), **{key: body[key] for key in ("level", "source", "text")}})
            self._log_new = True

    def _take_planned(self, body: Body) -> None:
        """Keep the steps of the plan that is carried out, until it ends."""
        if body["status"] == "ended":
            self._plan = None
            return
        if self._plan is None or (self._plan["id"], len(self._plan["shapes"])) != (body["plan"], body["steps"]):
            self._plan = {"id": body["plan"], "step": -1, "shapes": [None] * body["steps"], "loads": [0.0] * body["steps"]}
            self._plan["pressed"] = None
        self._plan["stamp_ns"] = body["stamp_ns"]
        points = np.round(np.reshape(body["shape_m"], (-1, 3)), 4).tolist()
        if body["status"] == "loaded":
            self._plan["pressed"] = {"shape": points, "force": _list(body["contact_force_N"], 3)}
            return
        self._plan["shapes"][body["step"]] = points
        self._plan["loads"][body["step"]] = _rounded(body["load_N"], 3)
        if body["status"] == "executing":
            self._plan["step"] = body["step"]

    def _planned(self) -> dict[str, Any] | None:
        """The plan that is carried out: its id, the step now (-1 before the first), shapes (m) and loads (N) by step.

        `pressed` is the goal under the planned contact force: shape (m) and force (N) on the tissue; None without one.
        """
        if self._plan is None or self.now_ns - self._plan["stamp_ns"] > PLAN_LASTS_NS:
            return None
        return {name: value for name, value in self._plan.items() if name != "stamp_ns"}

    def past(self) -> dict[str, Any]:
        """Samples and log of the last half minute, for a page that has just been opened."""
        return {**{name: list(rows) for name, rows in self._kept.items()}, "log": list(self._log)}

    def _along(self, estimate: Body) -> tuple[float | None, float | None]:
        """The estimate along the direction in which force is controlled, and its standard deviation; N."""
        direction = np.array(self._newest.get("state", {}).get("force_direction") or (0.0, 0.0, 1.0))
        force, covariance = estimate.get("force_N"), estimate.get("covariance_N2")
        if not estimate.get("converged") or force is None or covariance is None:
            return None, None
        variance = float(direction @ np.array(covariance).reshape(3, 3) @ direction)
        return _rounded(float(direction @ np.array(force)), 5), _rounded(math.sqrt(max(variance, 0.0)), 5)

    def _fresh(self, topic: str, lasts_ns: int) -> Body:
        body = self._newest.get(topic, {})
        return body if body and self.now_ns - body["stamp_ns"] <= lasts_ns else {}

    def _force(self) -> Sequence[float] | None:
        """The best word on the force of the tip on the tissue now: the sensor's, else the estimate's."""
        sensed = self._fresh("force/sensor", ESTIMATE_LASTS_NS).get("force_N")
        return sensed if sensed is not None else self._estimate()

    def _estimate(self) -> Sequence[float] | None:
        estimate = self._fresh("force/estimate", ESTIMATE_LASTS_NS)
        return estimate.get("force_N") if estimate.get("converged") else None

    def scene(self) -> dict[str, Any]:
        """Shape, tip, sensors, target, force and wall direction in the base frame, m and N; nil where not known."""
        state, stage = self._newest.get("state", {}), self._newest.get("stage", {})
        tracked = self._fresh("pose/tip", POSE_LASTS_NS)
        tip = state.get("tip_m") if tracked.get("position_m") is not None else None
        joints = [stage.get(f"joint_{name}") for name in ("insertion_m", "roll_rad", "curvature_per_m")]
        force = self._force()
        points, gap_m = None, None
        if self._shape is not None and None not in joints:
            points, gap_m = self._shape(joints, force, tip)
        target = state.get("target_m")
        return {
            "shape_m": points,
            "gap_m": gap_m,
            "tip_m": tip,
            "force_N": force,
            "estimate_N": self._estimate(),
            "target_m": target if target and any(target) else None,
            "into": state.get("force_direction"),
            "poses": {name: self._fresh(f"pose/{name}", POSE_LASTS_NS) for name in ("tip", "shaft", "rear")},
        }

    def frame(self) -> dict[str, Any]:
        """All that the page shows, as plain JSON; the traces' new samples are handed out once."""
        state = self._newest.get("state", {})
        frame = {
            "t": _seconds(self.now_ns),
            "mode": state.get("mode", ""),
            "action": state.get("safety_action", ""),
            "causes": causes_of(state.get("cause", "")),
            "first": self._first(),
            "force_N": _rounded(state.get("force_N"), 4),
            "target_force_N": state.get("target_force_N"),
            "pose_age_ms": _rounded(_ms(state.get("pose_age_ns")), 1),
            "rejected": [state.get("poses_rejected", 0), state.get("forces_rejected", 0)],
            "rows": list(self._force_rows),
            "estimates": list(self._estimate_rows),
            "scene": self._drawn(),
            "plan": self._planned(),
            "loop": self._loop(),
            "board": self._board(),
            "model": self._model(),
        }
        self._force_rows.clear()
        self._estimate_rows.clear()
        if self._log_new:
            frame["log"], self._log_new = list(self._log), False
        return frame

    def _first(self) -> dict[str, Any] | None:
        """The first cause of what stands, its remedy, and what followed; None while nothing holds the rig back."""
        first = self._newest.get("cause", {})
        if not first.get("name"):
            return None
        return {"says": first["says"], "remedy": first["remedy"], "followed": first["followed"].splitlines()}

    def _drawn(self) -> dict[str, Any]:
        """The scene with numbers short enough to be sent thirty times a second: 10 um, 0.1 mN."""
        scene = self.scene()
        poses = {
            name: [*_list(body.get("position_m"), 5), *_list(body.get("quaternion_wxyz"), 4)]
            for name, body in scene["poses"].items()
            if body.get("position_m") is not None
        }
        points = scene["shape_m"]
        return {
            "shape": None if points is None else np.round(points, 5).tolist(),
            "gap_m": _rounded(scene["gap_m"], 5),
            "tip": _list(scene["tip_m"], 5),
            "force": _list(scene["force_N"], 4),
            "estimate": _list(scene["estimate_N"], 4),
            "target": _list(scene["target_m"], 5),
            "into": _list(scene["into"], 4),
            "poses": poses,
        }

    def _loop(self) -> dict[str, Any] | None:
        loop = self._newest.get("loop")
        if loop is None:
            return None
        names = (
            "loop_hz",
            "ticks",
            "missed_ticks",
            "tick_p50_us",
            "tick_p99_us",
            "tick_p999_us",
            "tick_max_us",
            "lateness_p50_us",
            "lateness_p99_us",
            "lateness_p999_us",
            "lateness_max_us",
            "longest_gap_where",
        )
        return {**{name: loop.get(name) for name in names}, "longest_gap_ms": _ms(loop.get("longest_gap_ns"))}

    def _model(self) -> dict[str, Any] | None:
        """What the model process has learned of the catheter and its contacts; None before it has said anything."""
        stiffness, contact = self._newest.get("stiffness", {}), self._newest.get("contact", {})
        if not stiffness and not contact:
            return None
        return {
            **{name: stiffness.get(name) for name in ("scale", "sd", "adaptation", "text")},
            "place": contact.get("place"),
            "sensors": contact.get("sensors"),
            "body_offset_m": contact.get("body_offset_m"),
            "body_offset_sd_m": contact.get("body_offset_sd_m"),
            "contact_text": contact.get("text"),
        }

    def _board(self) -> dict[str, Any] | None:
        board = self._newest.get("board")
        if board is None:
            return None
        names = (
            "fault",
            "fault_name",
            "queue_depth",
            "crc_errors",
            "host_crc_errors",
            "underruns",
            "rejected",
            "last_reject",
            "boot_count",
            "deadman_age_ms",
            "inputs",
            "position_steps",
            "encoder_counts",
        )
        state = BoardState.label_of(board.get("state", 0))
        age_ms = max(self.now_ns - board["stamp_ns"], 0) * 1e-6
        return {**{name: board.get(name) for name in names}, "state": state, "age_ms": _rounded(age_ms, 0)}


def causes_of(text: str) -> list[str]:
    """The sentences in a state's `cause`, one for each thing that is wrong: they are joined by what they also contain."""
    from realtime.control.safety import CAUSES  # with a compiler behind it, that who only reads recordings need not wait for

    known = [sentence for _, _, _, sentence in CAUSES if sentence in text]
    rest = text
    for sentence in known:
        rest = rest.replace(sentence, "")
    return sorted(known, key=text.index) if not rest.strip("; ") else [text]


def _shape_of(parameters: Body) -> Callable[..., tuple[Any, float | None]] | None:
    """Joints, force and tip to points and gap, None where the catheter is not known; loads the models, so only on need."""
    from host.recordings.drawn_shape import catheter_of, through, twin

    catheter = catheter_of(parameters)

    def shape(
        joints: Sequence[float], force_N: Sequence[float] | None, tip_m: Sequence[float] | None
    ) -> tuple[Any, float | None]:
        points = twin(catheter, joints[0], joints[1], joints[2], force_N) if catheter else None
        return (None, None) if points is None else through(points, tip_m)

    if catheter is None:
        return None
    # Once now: the kernels are loaded before anything waits for a frame or a recording.
    shape((-0.5 * catheter.distal_length_m, 0.0, 0.0), None, None)
    return shape


def _seconds(stamp_ns: int) -> float:
    return round(stamp_ns * 1e-9, 4)


def _ms(time_ns: float | None) -> float | None:
    return None if time_ns is None else time_ns * 1e-6


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(float(value), digits)


def _list(values: Sequence[float] | None, digits: int) -> list[float]:
    """Return rounded numbers; an absent value (nil) gives an empty list."""
    return [] if values is None else [round(float(value), digits) for value in values]
