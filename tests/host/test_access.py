"""Access from other machines, over real TLS sessions: who gets in, who reads, who commands, and who is refused what."""

from __future__ import annotations

import datetime
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh
from cryptography import x509

from host.run.commander import Commander
from host.run.wall_clock import with_folder
from host.security import keys
from protocol.local_paths import LocalPaths
from protocol.topics import Command, ForceSensor, Message, Reply, encode, key, request_key
from protocol.zenoh_access import CA_FILE, CERTIFICATE_FILE, KEY_FILE, Network, client_settings
from protocol.zenoh_session import Session
from realtime.core.command_gate import CommandGate
from tests.realtime.conftest import RIG_FILE
from tests.waiting import free_port, until


def reading(force_N: float = 0.2) -> ForceSensor:
    return ForceSensor(stamp_ns=0, arrival_ns=0, force_N=(0.0, 0.0, force_N))


class Laboratory:
    """A host session that listens to other machines, a realtime session behind it with a gate, and certificates."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.endpoint = f"tls/127.0.0.1:{free_port()}"
        keys.make_authority(folder)
        keys.issue(folder, "rig1", "rig", addresses=["127.0.0.1"])
        for name, role in (
            ("analysis", "reader"),
            ("console", "commander"),
            ("second", "commander"),
            ("dismissed", "commander"),
            ("promoted", "reader"),
        ):
            keys.issue(folder, name, role, connect=self.endpoint)
        # `dismissed` has a good certificate and is in no list; `promoted` is listed above what its certificate says.
        network = Network("simulated", (self.endpoint,), folder / "rig1", ("analysis",), ("console", "second", "promoted"))
        local = f"tcp/127.0.0.1:{free_port()}"
        self.host = Session("simulated", [local], [], network)
        self.realtime = Session("simulated", [], [local])
        self.done: list[Command] = []
        self.gate = CommandGate(time.monotonic_ns, self.obey, roles=network.roles)
        self.asked: list[str] = []
        self.server = self.realtime.serve_requests(self.answer)
        self.publisher = self.realtime.publisher("force/sensor")
        heard = self.host.latest("force/sensor")
        assert until(lambda: self.publisher.put(reading()) is None and heard.take() is not None)

    def obey(self, command: Command, now_ns: int) -> Reply:
        self.done.append(command)
        return Reply(stamp_ns=now_ns, id=command.id, result="accepted")

    def answer(self, name: str, payload: bytes) -> Reply | None:
        self.asked.append(name)
        return self.gate.answer(name, payload)[1]

    def works_for(self, name: str) -> bool:
        """Whether `name` gets in and commands: shows that the rig is there while others are refused."""
        with Session.remote("simulated", self.endpoint, self.folder / name) as session:
            commander = Commander(session, name, timeout_s=0.5)
            return until(lambda: any(path.answered for path in commander.stop().paths))


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Laboratory]:
    made = Laboratory(tmp_path_factory.mktemp("keys"))
    yield made
    made.realtime.close()
    made.host.close()


@pytest.mark.parametrize("name", ["analysis", "console"])
def test_a_right_certificate_reads(laboratory: Laboratory, name: str) -> None:
    with Session.remote("simulated", laboratory.endpoint, laboratory.folder / name) as session:
        latest = session.latest("force/sensor")
        assert until(lambda: laboratory.publisher.put(reading()) is None and latest.take() is not None)


def test_a_commander_takes_the_lease_and_commands_in_its_own_name_only(laboratory: Laboratory) -> None:
    with Session.remote("simulated", laboratory.endpoint, laboratory.folder / "console") as session:
        commander = Commander(session, "console", timeout_s=1.0)
        assert until(lambda: commander.take().accepted and commander.arm().accepted)
        assert until(lambda: commander.release().accepted)
        before = len(laboratory.asked)
        for other in ("second", "local"):
            assert Commander(session, other, timeout_s=0.4).stop().result == "not confirmed"
        assert list(session.zenoh.get(request_key("simulated", "*"), payload=b"x", timeout=0.4)) == []
        assert set(laboratory.asked[before:]) <= {"console"}


@pytest.mark.parametrize("name", ["analysis", "dismissed", "promoted"])
def test_the_wrong_role_commands_nothing(laboratory: Laboratory, name: str) -> None:
    assert laboratory.works_for("console")
    done, asked = len(laboratory.done), len(laboratory.asked)
    with Session.remote("simulated", laboratory.endpoint, laboratory.folder / name) as session:
        for claimed in (name, "console"):
            commander = Commander(session, claimed, timeout_s=0.4)
            assert [commander.stop().result, commander.take().result] == ["not confirmed", "unanswered"]
    assert (len(laboratory.done), len(laboratory.asked)) == (done, asked)


@pytest.mark.parametrize("name", ["dismissed", "promoted"])
def test_who_is_in_no_list_reads_nothing(laboratory: Laboratory, name: str) -> None:
    with (
        Session.remote("simulated", laboratory.endpoint, laboratory.folder / name) as stranger,
        Session.remote("simulated", laboratory.endpoint, laboratory.folder / "analysis") as reader,
    ):
        wanted, all_keys = (
            stranger.latest("force/sensor"),
            stranger.zenoh.declare_subscriber("**", zenoh.handlers.RingChannel(10)),
        )
        latest = reader.latest("force/sensor")
        assert until(lambda: laboratory.publisher.put(reading()) is None and latest.take() is not None)
        time.sleep(0.3)
        assert wanted.take() is None and all_keys.try_recv() is None


@pytest.mark.parametrize("mode", ["client", "peer", "router"])
@pytest.mark.parametrize("name", ["analysis", "console"])
def test_nobody_outside_publishes_or_answers_for_the_rig(laboratory: Laboratory, name: str, mode: str) -> None:
    config = zenoh.Config.from_json5(
        json.dumps(
            client_settings(laboratory.endpoint, laboratory.folder / name) | {"mode": mode, "listen": {"endpoints": []}}
        )
    )
    inside = [session.everything() for session in (laboratory.host, laboratory.realtime)]
    with zenoh.open(config) as session:
        hijacked: list[Any] = []
        taken = session.declare_queryable(request_key("simulated", "*"), hijacked.append, complete=True)
        heard = session.declare_subscriber(key("simulated", "force/sensor"), zenoh.handlers.RingChannel(1))
        assert until(lambda: laboratory.publisher.put(reading()) is None and heard.try_recv() is not None)
        forged = reading(77.0)
        for topic in ("force/sensor", "force/estimate", "state", "request", "log"):
            session.put(key("simulated", topic), encode(forged))
            session.delete(key("simulated", topic))
        session.put(request_key("simulated", "console"), b"x")
        local = Commander(laboratory.host, "local", timeout_s=2.0)
        assert until(lambda: local.hold().accepted)
        messages: list[list[Message]] = [[], []]

        def all_heard() -> bool:
            for everything, mine in zip(inside, messages, strict=True):
                mine += [message for _, message, _ in everything.take()]
            return all(messages)

        until(all_heard, "a message inside")
        time.sleep(0.3)
        assert all_heard()
        for message in messages[0] + messages[1]:
            assert message == msgspec.structs.replace(reading(), sequence=message.sequence)
        assert not any(everything.malformed for everything in inside)
        assert not hijacked and taken is not None


def test_the_model_process_opens_the_way_in_that_the_rig_file_describes(laboratory: Laboratory, tmp_path: Path) -> None:
    local, outside = LocalPaths(tmp_path).endpoint, f"tls/127.0.0.1:{free_port()}"
    text = RIG_FILE.read_text(encoding="utf-8")
    section = keys.network_lines(laboratory.folder, outside)
    (tmp_path / "rig.toml").write_text(with_folder(text[: text.index("[network]")] + section, tmp_path), encoding="utf-8")
    child = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "host.run.model_process",
            str(tmp_path / "rig.toml"),
            "--estimator",
            "tests.host.no_estimator:make",
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert child.stdout is not None and "ready" in child.stdout.readline()
        with (
            Session("simulated", [], [local]) as realtime,
            Session.remote("simulated", outside, laboratory.folder / "analysis") as reader,
        ):
            publisher, latest = realtime.publisher("force/sensor"), reader.latest("force/sensor")
            assert until(lambda: publisher.put(reading()) is None and latest.take() is not None)
    finally:
        child.terminate()
        child.wait()
        child.stdout.close()  # type: ignore[union-attr]


def refused(settings: dict[str, Any]) -> bool:
    settings["connect"]["timeout_ms"] = 1500
    try:
        session = zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    except zenoh.ZError:
        return True
    session.close()
    return False


def let_in(settings: dict[str, Any]) -> bool:
    """Whether a session is opened, sooner or later."""
    return until(lambda: not refused(settings))


def test_the_open_way_in_is_open_to_the_right_certificate(laboratory: Laboratory) -> None:
    assert let_in(client_settings(laboratory.endpoint, laboratory.folder / "analysis"))


def test_no_certificate_gets_no_session(laboratory: Laboratory) -> None:
    settings = client_settings(laboratory.endpoint, laboratory.folder / "analysis")
    tls = settings["transport"]["link"]["tls"]
    del tls["connect_private_key_base64"], tls["connect_certificate_base64"]
    assert refused(settings | {})
    tls["enable_mtls"] = False
    assert refused(settings)


def test_plain_tcp_at_the_tls_port_gets_no_session(laboratory: Laboratory) -> None:
    endpoint = laboratory.endpoint.replace("tls/", "tcp/")
    assert refused({"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}})


def test_a_certificate_of_another_authority_gets_no_session(laboratory: Laboratory, tmp_path: Path) -> None:
    keys.make_authority(tmp_path)
    keys.issue(tmp_path, "console", "commander")
    assert refused(client_settings(laboratory.endpoint, tmp_path / "console"))
    trusting = client_settings(laboratory.endpoint, tmp_path / "console")
    right = client_settings(laboratory.endpoint, laboratory.folder / "console")
    trusting["transport"]["link"]["tls"]["root_ca_certificate_base64"] = right["transport"]["link"]["tls"][
        "root_ca_certificate_base64"
    ]
    assert refused(trusting), "it trusts the rig, but the rig must not trust it"


def test_a_rig_of_another_authority_is_not_believed(laboratory: Laboratory, tmp_path: Path) -> None:
    keys.make_authority(tmp_path)
    settings = client_settings(laboratory.endpoint, laboratory.folder / "console")
    other = client_settings(laboratory.endpoint, keys.issue(tmp_path, "console", "commander").folder)
    settings["transport"]["link"]["tls"]["root_ca_certificate_base64"] = other["transport"]["link"]["tls"][
        "root_ca_certificate_base64"
    ]
    assert refused(settings)


def test_an_expired_certificate_gets_no_session(laboratory: Laboratory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keys, "_BACKDATED", datetime.timedelta(days=3))
    monkeypatch.setattr(keys, "_life", lambda days, ca: datetime.timedelta(days=-1))
    one = keys.issue(laboratory.folder, "late", "commander")
    assert one.expires < datetime.datetime.now(datetime.UTC)
    assert refused(client_settings(laboratory.endpoint, one.folder))


def test_a_certificate_of_a_reader_cannot_stand_for_a_rig(laboratory: Laboratory) -> None:
    for name, stands in (("rig1", True), ("second", False)):
        endpoint = f"tls/127.0.0.1:{free_port()}"
        network = Network("simulated", (endpoint,), laboratory.folder / name, ("analysis",))
        with Session("simulated", [], [], network):
            assert (let_in if stands else refused)(client_settings(endpoint, laboratory.folder / "analysis"))


def test_a_rig_at_an_address_it_was_not_made_for_is_not_believed(laboratory: Laboratory) -> None:
    endpoint = laboratory.endpoint.replace("127.0.0.1", "127.0.0.2")
    network = Network("simulated", (endpoint,), laboratory.folder / "rig1", ("analysis",))
    with Session("simulated", [], [], network):
        settings = client_settings(endpoint, laboratory.folder / "analysis")
        assert refused(settings)
        settings["transport"]["link"]["tls"]["verify_name_on_connect"] = False
        assert let_in(settings)


def test_keys_are_private_and_certificates_say_what_they_are_for(laboratory: Laboratory) -> None:
    for one in keys.issued(laboratory.folder):
        assert (one.folder / KEY_FILE).stat().st_mode & 0o777 == 0o600 and one.folder.stat().st_mode & 0o777 == 0o700
        certificate = x509.load_pem_x509_certificate((one.folder / CERTIFICATE_FILE).read_bytes())
        ca = x509.load_pem_x509_certificate((one.folder / CA_FILE).read_bytes())
        certificate.verify_directly_issued_by(ca)
        assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        assert certificate.not_valid_after_utc <= ca.not_valid_after_utc
    serials = [one.serial for one in keys.issued(laboratory.folder)]
    assert len(set(serials)) == len(serials) >= 6


def test_a_network_without_its_keys_does_not_open(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"network\.keys: found .* without ca\.pem"):
        Session("simulated", [], [], Network("simulated", ("tls/127.0.0.1:7999",), tmp_path))
    with pytest.raises(ValueError, match=r"wanted tls/ADDRESS:PORT"):
        Session("simulated", [], [], Network("simulated", ("tcp/127.0.0.1:7999",), tmp_path))
