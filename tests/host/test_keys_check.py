"""The keys folder that a rig file names: each thing that is wrong with it is one line, a good one is silent."""

from __future__ import annotations

import datetime
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from host.cli.rig import rig as app
from host.security import keys
from host.security.keys_check import keys_problems
from protocol.zenoh_access import CA_FILE, CERTIFICATE_FILE, KEY_FILE
from tests.realtime.conftest import RIG_FILE

LISTEN = ["tls/192.168.10.5:7448"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    keys.make_authority(tmp_path / "keys")
    return keys.issue(tmp_path / "keys", "rig1", "rig", addresses=["192.168.10.5", "rig.lab"]).folder


def other(folder: Path, role: str = "rig") -> Path:
    """A folder of another laboratory."""
    away = folder.parent.parent / "elsewhere"
    keys.make_authority(away)
    return keys.issue(away, "theirs", role, addresses=["192.168.10.5"] if role == "rig" else []).folder


def take(name: str) -> Callable[[Path], object]:
    return lambda folder: shutil.copy(other(folder) / name, folder / name)


@pytest.mark.parametrize("listen", [LISTEN, ["tls/rig.lab:7448", "tls/0.0.0.0:7448", "tls/[::]:7448"]])
def test_what_keys_issue_makes_is_good(folder: Path, listen: list[str]) -> None:
    assert keys_problems(folder, listen) == []


@pytest.mark.parametrize(
    ("harm", "says"),
    [
        (lambda folder: (folder / CERTIFICATE_FILE).unlink(), "certificate.pem: found No such file"),
        (lambda folder: (folder / CA_FILE).unlink(), "ca.pem: found No such file"),
        (lambda folder: (folder / KEY_FILE).unlink(), "key.pem: found No such file"),
        (
            lambda folder: (folder / KEY_FILE).chmod(0o640),
            "key.pem: found mode 0640, which lets others read it, wanted 0600",
        ),
        (lambda folder: (folder / KEY_FILE).write_text("rubbish"), "key.pem: found no private key in it"),
        (lambda folder: (folder / CERTIFICATE_FILE).write_text("rubbish"), "certificate.pem: found no certificate in it"),
        (take(CA_FILE), "certificate.pem: found a certificate of another authority, wanted one of ca.pem"),
        (take(KEY_FILE), "key.pem: found the key of another certificate"),
    ],
)
def test_each_thing_that_is_wrong_is_one_line(folder: Path, harm: Callable[[Path], object], says: str) -> None:
    harm(folder)
    problems = keys_problems(folder, LISTEN)
    assert len(problems) == 1 and says in problems[0] and "wanted" in problems[0]


def test_time_address_role_and_a_folder_that_is_not_there(folder: Path) -> None:
    now = datetime.datetime.now(datetime.UTC)
    late = keys_problems(folder, LISTEN, now + datetime.timedelta(days=keys.DAYS + 1))
    assert len(late) == 1 and "certificate.pem: found that it expired on" in late[0]
    early = keys_problems(folder, LISTEN, now - datetime.timedelta(days=2))
    assert len(early) == 2 and all("is this machine's clock right?" in line for line in early)
    elsewhere = keys_problems(folder, ["tls/192.168.10.6:7448"])
    assert elsewhere == [
        "network.listen: found tls/192.168.10.6:7448, wanted an address that the certificate was made for: "
        "192.168.10.5, rig.lab"
    ]
    reader = keys.issue(folder.parent, "analysis", "reader").folder
    assert "found the certificate of reader.analysis, wanted one issued with --role rig" in keys_problems(reader, LISTEN)[0]
    assert "found no folder" in keys_problems(folder / "nowhere", LISTEN)[0]


def test_rig_check_looks_at_the_folder(folder: Path, tmp_path: Path) -> None:
    text = RIG_FILE.read_text(encoding="utf-8")
    file = tmp_path / "rig.toml"
    file.write_text(text[: text.index("[network]")] + keys.network_lines(folder.parent, LISTEN[0]), encoding="utf-8")
    assert CliRunner().invoke(app, ["check", str(file)]).exit_code == 0
    os.chmod(folder / KEY_FILE, 0o644)
    told = CliRunner().invoke(app, ["check", str(file)])
    assert told.exit_code == 2 and told.stderr.count("\n") == 1 and "key.pem: found mode 0644" in told.stderr
