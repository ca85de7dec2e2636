"""The NDI wire format against bytes written out by hand, and against damage."""

import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realtime.drivers import ndi_protocol as ndi

VECTORS = json.loads((Path(__file__).parent / "vectors" / "aurora.json").read_text(encoding="utf-8"))


def vector_bytes(vector: dict) -> bytes:
    return bytes.fromhex(vector["hex"]) if "hex" in vector else vector["text"].encode("ascii")


def read_one(data: bytes) -> ndi.NdiReply:
    replies = ndi.ReplyReader().feed(data)
    assert len(replies) == 1
    assert replies[0].n_bytes == len(data)
    return replies[0]


def parse(kind: str, data: bytes) -> ndi.TrackingReply:
    reply = read_one(data)
    return ndi.parse_bx(reply.binary or b"") if kind == "BX" else ndi.parse_tx(reply.text or "")


@pytest.mark.parametrize("exchange", VECTORS["session"][1:], ids=lambda exchange: exchange["host"].strip())
def test_commands_have_the_bytes_of_the_vectors(exchange: dict) -> None:
    name, parameters = exchange["host"].strip()[:-4].split(":")
    assert ndi.command(name, parameters) == exchange["host"].encode("ascii")
    assert read_one(exchange["device"].encode("ascii")).text == exchange["device"][:-5]


@pytest.mark.parametrize("vector", VECTORS["replies"], ids=lambda vector: vector["meaning"])
def test_tracking_replies_mean_what_the_vectors_say(vector: dict) -> None:
    reply = parse(vector["kind"], vector_bytes(vector))
    assert reply.system_status == vector["system_status"]
    assert [tool.handle for tool in reply.tools] == [wanted["handle"] for wanted in vector["tools"]]
    for tool, wanted in zip(reply.tools, vector["tools"], strict=True):
        assert (tool.state.name, int(tool.status), tool.frame) == (wanted["state"], wanted["status"], wanted["frame"])
        for value, expected in ((tool.quaternion_wxyz, wanted["quaternion_wxyz"]), (tool.position_m, wanted["position_m"])):
            assert value is expected if expected is None else value == pytest.approx(expected, abs=1e-9)
        if wanted["error_m"] is not None:
            assert tool.error_m == pytest.approx(wanted["error_m"], abs=1e-12)


@pytest.mark.parametrize("vector", VECTORS["damaged"], ids=lambda vector: vector["meaning"])
def test_damaged_replies_are_dropped_and_the_next_one_is_found(vector: dict) -> None:
    good = vector_bytes(VECTORS["replies"][0])
    reader = ndi.ReplyReader()
    replies = reader.feed(vector_bytes(vector)) + reader.feed(good)
    assert [reply.binary for reply in replies] == [read_one(good).binary]
    assert reader.damaged >= 1


@pytest.mark.parametrize("vector", VECTORS["refused"], ids=lambda vector: vector["meaning"])
def test_replies_that_do_not_add_up_are_refused_though_their_crc_is_right(vector: dict) -> None:
    with pytest.raises(ndi.ProtocolError, match="found"):
        parse(vector["kind"], vector_bytes(vector))


@pytest.mark.parametrize("vector", VECTORS["words"], ids=lambda vector: vector["words"])
def test_codes_are_told_in_words(vector: dict) -> None:
    assert ndi.describe_reply(read_one(vector_bytes(vector)).text or "") == vector["words"]


def test_every_system_status_bit_has_words() -> None:
    for bit, text in ndi.SYSTEM_STATUS_TEXTS.items():
        assert ndi.describe_system_status(bit) == text
    assert ndi.describe_system_status(0) == ""


@given(st.lists(st.sampled_from(VECTORS["replies"]), min_size=1, max_size=5), st.data())
@settings(derandomize=True, deadline=None, max_examples=50)
def test_a_stream_cut_anywhere_gives_the_same_replies(vectors: list[dict], data: st.DataObject) -> None:
    stream = b"".join(vector_bytes(vector) for vector in vectors)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=12)))
    reader, replies = ndi.ReplyReader(), []
    for start, stop in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        replies += reader.feed(stream[start:stop])
    assert replies == ndi.ReplyReader().feed(stream)
    assert len(replies) == len(vectors) and reader.damaged == 0


@given(st.sampled_from(VECTORS["replies"]), st.data())
@settings(derandomize=True, deadline=None, max_examples=300)
def test_up_to_three_flipped_bits_are_never_accepted(vector: dict, data: st.DataObject) -> None:
    good = vector_bytes(vector)
    bits = data.draw(st.lists(st.integers(0, 8 * len(good) - 1), min_size=1, max_size=3, unique=True))
    damaged = bytearray(good)
    for bit in bits:
        damaged[bit // 8] ^= 1 << bit % 8
    accepted = ndi.ReplyReader().feed(bytes(damaged))
    # A flip inside the hex CRC of a text may end the line early, or start one; nothing of it has the reply's length.
    assert all(reply.n_bytes < 10 for reply in accepted)


@given(st.binary(max_size=400))
@settings(derandomize=True, deadline=None, max_examples=300)
def test_nothing_that_arrives_raises(noise: bytes) -> None:
    reader = ndi.ReplyReader()
    for reply in reader.feed(noise):
        for parser in (ndi.parse_tx, ndi.parse_phsr, ndi.parse_phinf):
            with pytest.raises(ndi.ProtocolError):
                parser(reply.text or "")


@given(st.binary(max_size=120))
@settings(derandomize=True, deadline=None, max_examples=300)
def test_bx_bodies_are_parsed_whole_or_refused(body: bytes) -> None:
    try:
        reply = ndi.parse_bx(body)
    except ndi.ProtocolError:
        return
    sizes = {ndi.HandleState.VALID: 42, ndi.HandleState.MISSING: 10, ndi.HandleState.DISABLED: 2}
    assert len(body) == 3 + sum(sizes[tool.state] for tool in reply.tools)
