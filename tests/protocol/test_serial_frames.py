"""The declaration is sound, and the C header is the one it makes."""

import re
import subprocess
import sys

from protocol import c_header
from protocol.serial_frames import ENUMS, FRAMES, MAX_BODY_BYTES, PROTOCOL_HASH, WIRE_BYTES, wire_bytes


def test_names_and_ids_are_unique() -> None:
    assert len({f.name for f in FRAMES}) == len({f.id for f in FRAMES}) == len(FRAMES)


def test_ids_tell_the_direction() -> None:
    assert all((f.id >= 0x80) == (f.to == "host") for f in FRAMES)


def test_every_field_is_described() -> None:
    for frame in FRAMES:
        assert frame.doc.endswith(".")
        for field in frame.fields:
            assert field.wire in WIRE_BYTES and field.unit and field.doc and field.scale > 0 and field.count >= 1


def test_time_fields_carry_their_unit_in_name_and_scale() -> None:
    scale = {"us": 1e-6, "ms": 1e-3}
    for frame in FRAMES:
        for field in frame.fields:
            if field.unit in scale:
                assert field.name.endswith("_" + field.unit) and field.scale == scale[field.unit]


def test_frames_fit_one_cobs_block() -> None:
    assert MAX_BODY_BYTES < 254


def test_header_is_not_stale() -> None:
    result = subprocess.run([sys.executable, "-m", "protocol.c_header", "--check"], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_check_notices_a_stale_header(tmp_path, monkeypatch, capsys) -> None:
    stale = tmp_path / "frames.h"
    stale.write_text(c_header.header_text().replace("#define AXIS_COUNT 3", "#define AXIS_COUNT 4"))
    monkeypatch.setattr(sys, "argv", ["c_header", "--check", "--output", str(stale)])
    assert c_header.main() == 1
    assert "stale" in capsys.readouterr().err
    monkeypatch.setattr(sys, "argv", ["c_header", "--output", str(stale)])
    assert c_header.main() == 0 and stale.read_text() == c_header.header_text()


def test_header_holds_every_frame_code_and_the_hash() -> None:
    text = c_header.header_text()
    for frame in FRAMES:
        assert f"#define FRAME_{frame.name} 0x{frame.id:02X} " in text
    for enum in ENUMS.values():
        for member in enum:
            assert re.search(rf"_{member.name} = {member.value},", text)
    assert f"PROTOCOL_HASH {PROTOCOL_HASH}UL" in text or f"PROTOCOL_HASH 0x{PROTOCOL_HASH:08X}UL" in text


def test_link_has_room_for_setpoints_and_status() -> None:
    by_name = {f.name: f for f in FRAMES}
    line_bytes_per_s = 500_000 / 10
    assert 1000 * wire_bytes(by_name["SETPOINT"]) < 0.6 * line_bytes_per_s
    assert 200 * wire_bytes(by_name["STATUS"]) < 0.3 * line_bytes_per_s
