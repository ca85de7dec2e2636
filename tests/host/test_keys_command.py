"""`seldinger keys` as it is called: what it writes, what it prints for the rig file, and what it refuses in one line."""

from __future__ import annotations

import datetime
import io
import json
import sys
from pathlib import Path

import pytest
import zenoh

from host.cli.main import main
from host.run.service_units import UnitSettings, unit_texts
from host.security import keys
from protocol.errors import InputError
from protocol.rig_file import load_rig, parse_rig, read_rig_data
from tests.realtime.conftest import RIG_FILE


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["seldinger", "keys", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


@pytest.fixture
def laboratory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, "init") == 0
    assert run(monkeypatch, "issue", "rig1", "--role", "rig", "--address", "10.0.0.5", "--address", "rig.lab") == 0
    assert run(monkeypatch, "issue", "analysis", "--role", "reader", "--connect", "tls/10.0.0.5:7448") == 0
    return tmp_path / "keys"


def test_what_is_printed_makes_a_good_rig_file(
    laboratory: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert run(monkeypatch, "issue", "console", "--role", "commander", "--connect", "tls/10.0.0.5:7448") == 0
    lines = capsys.readouterr().out
    text = RIG_FILE.read_text(encoding="utf-8")
    own = laboratory / "rig.toml"
    own.write_text(text[: text.index("[network]")] + lines, encoding="utf-8")
    access = load_rig(own).access
    assert access is not None and access.listen == ("tls/10.0.0.5:7448",) and access.keys == laboratory / "rig1"
    assert access.roles == {"analysis": "reader", "console": "commander"}


def test_the_zenoh_file_holds_all_and_is_private(laboratory: Path) -> None:
    path = laboratory / "analysis" / keys.CLIENT_FILE
    assert path.stat().st_mode & 0o777 == 0o600 and str(laboratory) not in path.read_text(encoding="utf-8")
    config = zenoh.Config.from_file(str(path))
    assert config.get_json("scouting/multicast/enabled") == "false" and "10.0.0.5" in config.get_json("connect")


def test_show_lists_all_and_fails_when_one_has_expired(
    laboratory: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert run(monkeypatch, "show", "--json") == 0
    rows = json.loads(capsys.readouterr().out)["certificates"]
    assert [(row["name"], row["role"], row["state"]) for row in rows] == [
        ("analysis", "reader", "valid"),
        ("rig1", "rig", "valid"),
    ]
    monkeypatch.setattr(keys, "_BACKDATED", datetime.timedelta(days=3))
    monkeypatch.setattr(keys, "_life", lambda days, ca: datetime.timedelta(days=-1))
    keys.issue(laboratory, "late", "reader")
    assert run(monkeypatch, "show") == 1 and "expired" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("init",), "directory: found"),
        (("issue", "analysis", "--role", "reader"), "name: found"),
        (("issue", "authority", "--role", "reader"), "name: found"),
        (("issue", "../x", "--role", "reader"), "name: found"),
        (("issue", "Console", "--role", "reader"), "name: found"),
        (("issue", "new", "--role", "boss"), "role: found"),
        (("issue", "new", "--role", "rig"), "address: found"),
        (("issue", "new", "--role", "reader", "--address", "10.0.0.6"), "address: found"),
        (("issue", "new", "--role", "rig", "--address", "10.0.0.300"), "address: found"),
        (("issue", "new", "--role", "reader", "--connect", "tcp/10.0.0.5:7448"), "connect: found"),
        (("issue", "new", "--role", "reader", "--days", "0"), "days: found"),
        (("issue", "new", "--role", "reader", "--directory", "nowhere"), "directory: found"),
    ],
)
def test_what_is_refused_leaves_everything_as_it_was(
    laboratory: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    says: str,
) -> None:
    def contents() -> dict[str, bytes]:
        return {str(path): path.read_bytes() for path in laboratory.parent.rglob("*") if path.is_file()}

    before = contents()
    capsys.readouterr()
    assert run(monkeypatch, *arguments) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"seldinger: {says}") and told.count("\n") == 1
    assert contents() == before


@pytest.mark.parametrize(
    "changes",
    [
        {"listen": ["tcp/10.0.0.5:7448"]},
        {"listen": ["tls/10.0.0.5"]},
        {"keys": "keys/rig1"},
        {"readers": ["a", "a"]},
        {"readers": ["console"]},
        {"commanders": ["a/b"]},
        {"peers": ["everybody"]},
        {"reader": ["a"]},
    ],
)
def test_a_bad_network_section_is_refused(changes: dict[str, list[str]]) -> None:
    data = read_rig_data(RIG_FILE)
    good = {
        "listen": ["tls/10.0.0.5:7448"],
        "keys": "/keys/rig1",
        "readers": ["analysis"],
        "commanders": ["console"],
        "peers": ["10.0.0.0/24"],
    }
    assert parse_rig(data | {"network": good}).access is not None
    with pytest.raises(ValueError, match="network"):
        parse_rig(data | {"network": good | changes})


def test_the_installed_model_process_may_talk_to_the_peers_and_the_loop_may_not() -> None:
    data = read_rig_data(RIG_FILE)
    section = {"listen": ["tls/10.0.0.5:7448"], "keys": "/keys/rig1", "peers": ["10.0.0.7", "10.1.0.0/16"]}
    texts = unit_texts(UnitSettings(Path("/etc/rig.toml"), 1), parse_rig(data | {"network": section}))
    assert "IPAddressAllow=localhost 10.0.0.7 10.1.0.0/16\n" in texts["seldinger-host.service"]
    assert "10.0.0.7" not in texts["seldinger-realtime.service"]
    closed = unit_texts(UnitSettings(Path("/etc/rig.toml"), 1), parse_rig(data))
    assert "IPAddressAllow=localhost \n" in closed["seldinger-host.service"]


def test_a_key_with_a_passphrase_opens_with_it_alone(tmp_path: Path) -> None:
    keys.make_authority(tmp_path, passphrase="correct horse")
    assert keys.has_passphrase(tmp_path) and b"ENCRYPTED" in (tmp_path / "authority" / "key.pem").read_bytes()
    for wrong in ("", "wrong"):
        with pytest.raises(InputError, match="passphrase: found"):
            keys.issue(tmp_path, "analysis", "reader", passphrase=wrong)
    assert keys.issue(tmp_path, "analysis", "reader", passphrase="correct horse").role == "reader"


def test_the_command_reads_the_passphrase_from_a_file_that_is_its_users_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    secret = tmp_path / "passphrase"
    secret.write_text("correct horse\n")
    secret.chmod(0o644)
    words = ["-d", str(tmp_path / "keys"), "--passphrase-file", str(secret)]
    assert run(monkeypatch, "init", *words) == 2 and "chmod 600" in capsys.readouterr().err
    secret.chmod(0o600)
    assert run(monkeypatch, "init", *words) == 0
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    assert run(monkeypatch, "issue", "analysis", "--role", "reader", *words[:2]) == 2
    assert "--passphrase-file: found nothing" in capsys.readouterr().err
    assert run(monkeypatch, "issue", "analysis", "--role", "reader", *words) == 0
