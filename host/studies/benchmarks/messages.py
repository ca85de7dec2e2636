"""Benchmark of messages: decoding and encoding with every check; the peer is msgpack and pydantic on the same classes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import msgpack
import numpy as np
from pydantic import ConfigDict, Field, TypeAdapter, create_model

from host.studies.benchmarks.runner import Report, Row, alternate, row_of
from protocol.messages import FieldSpec, specs
from protocol.topics import ForceEstimate, ForceSensor, Message, Pose, RigState, Stage, decode, encode

CASES = 60
PER_CALL = 20  # messages of one call, so that the peer is longer than a reading of the clock
_PYTHON = {"float": float, "integer": int, "bool": bool, "text": str}


def message_of(rng: np.random.Generator, number: int) -> Message:
    """Return a message as the loop sends it at its highest rates."""
    stamp_ns, v = int(rng.integers(0, 10**15)), [float(value) for value in rng.uniform(-0.1, 0.1, 9)]
    kind = number % 5
    if kind == 0:
        return Stage(
            stamp_ns=stamp_ns,
            command_insertion_m=v[0],
            command_roll_rad=v[1],
            command_knob_rad=v[2],
            encoder_insertion_m=v[3],
            encoder_roll_rad=v[4],
            encoder_knob_rad=v[5],
        )
    if kind == 1:
        unit = (1.0, 0.0, 0.0, 0.0)
        place = (v[0], v[1], v[2])
        return Pose(
            stamp_ns=stamp_ns, arrival_ns=stamp_ns, frame=number, missing=False, position_m=place, quaternion_wxyz=unit
        )
    if kind == 2:
        return ForceSensor(stamp_ns=stamp_ns, arrival_ns=stamp_ns, force_N=(v[0], v[1], v[2]))
    if kind == 3:
        return ForceEstimate(
            stamp_ns=stamp_ns,
            frame="base",
            converged=True,
            force_N=(v[0], v[1], v[2]),
            covariance_N2=(1e-4, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 1e-4),
            published_ns=stamp_ns,
            compute_us=40.0,
        )
    return RigState(stamp_ns=stamp_ns, mode="contact", safety_action="none", tip_m=(v[0], v[1], v[2]), force_N=v[3])


def _pydantic_type(spec: FieldSpec) -> Any:
    kind: Any = _PYTHON[spec.kind]
    if spec.minimum is not None:
        kind = Annotated[kind, Field(ge=spec.minimum, le=spec.maximum)]
    if spec.columns:
        kind = tuple[(kind,) * len(spec.columns)]  # type: ignore[misc]
    return kind | None if spec.optional else kind


def peer_of(message_class: type[Message]) -> TypeAdapter[Any]:
    """Return pydantic's checks of the same fields with the same bounds."""
    fields: dict[str, Any] = {name: (_pydantic_type(spec), ...) for name, spec in specs(message_class).items()}
    config = ConfigDict(extra="forbid")
    return TypeAdapter(create_model(message_class.__name__, __config__=config, schema_version=(int, ...), **fields))


def _row(name: str, seed: int, ours: Callable[[Any, Any], Any], peer: Callable[[Any, Any, Any], Any]) -> Row:
    rng = np.random.default_rng(seed)
    messages = [message_of(rng, number) for number in range(CASES)]
    peers = {type(message): peer_of(type(message)) for message in messages}
    payloads = [encode(message) for message in messages]
    right = sum(decode(type(message), payload) == message for message, payload in zip(messages, payloads, strict=True))
    peer_right = sum(
        peers[type(message)].validate_python(msgpack.unpackb(payload)).stamp_ns == message.stamp_ns
        for message, payload in zip(messages, payloads, strict=True)
    )

    def mine(number: int, repeats: int) -> None:
        for _ in range(repeats * PER_CALL):
            ours(messages[number], payloads[number])

    def theirs(number: int) -> None:
        adapter = peers[type(messages[number])]
        for _ in range(PER_CALL):
            peer(adapter, messages[number], payloads[number])

    timed = alternate([partial(mine, n) for n in range(CASES)], [partial(theirs, n) for n in range(CASES)])
    timed.ours_s = [value / PER_CALL for value in timed.ours_s]
    timed.peer_s = [value / PER_CALL for value in timed.peer_s]
    return row_of(name, "five topics", "msgpack and pydantic", timed, seed, right=right, peer_right=peer_right)


def message_decode(seed: int, _report: Report) -> list[Row]:
    """Time decoding with the checks of type and bounds."""
    return [
        _row(
            "message_decode",
            seed,
            lambda message, payload: decode(type(message), payload),
            lambda adapter, message, payload: adapter.validate_python(msgpack.unpackb(payload)),
        )
    ]


def message_encode(seed: int, _report: Report) -> list[Row]:
    """Time encoding with the same checks; the peer checks a dict of the fields and packs it."""
    return [
        _row(
            "message_encode",
            seed,
            lambda message, payload: encode(message),
            lambda adapter, message, payload: msgpack.packb(
                adapter.validate_python(
                    {"schema_version": 1, **{n: getattr(message, n) for n in message.__struct_fields__}}
                ).model_dump()
            ),
        )
    ]
