"""Zenoh across machines: TLS with certificates on both sides, and access control that denies all that is not listed."""

from __future__ import annotations

import base64
import ipaddress
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from protocol.topics import TOPICS, check_name, key, request_key

ROLES = ("rig", "reader", "commander")
CA_FILE, CERTIFICATE_FILE, KEY_FILE = "ca.pem", "certificate.pem", "key.pem"
_TLS = re.compile(r"tls/(\[[0-9a-fA-F:]+\]|[A-Za-z0-9.-]{1,253}):(\d{1,5})")


@dataclass(frozen=True)
class Network:
    """Access of other machines to a rig: endpoints, folder of the keys, and the names of readers and commanders."""

    rig: str
    listen: tuple[str, ...]
    keys: Path
    readers: tuple[str, ...] = ()
    commanders: tuple[str, ...] = ()

    @property
    def roles(self) -> dict[str, str]:
        """Return name -> role of the clients that the rig file lists."""
        return dict.fromkeys(self.readers, "reader") | dict.fromkeys(self.commanders, "commander")


def common_name(role: str, name: str) -> str:
    """Return the common name of a certificate; it contains the role, so that the rig file cannot change the role."""
    return f"{role}.{name}"


def check_network_endpoint(endpoint: str) -> str:
    """Return `endpoint` if it is TLS with host and port. Raises ValueError, because other machines connect by TLS only."""
    match = _TLS.fullmatch(endpoint)
    if not match or not 0 < int(match[2]) < 65536:
        raise ValueError(f"endpoint: found {endpoint!r}, wanted tls/ADDRESS:PORT")
    if match[1].startswith("["):
        ipaddress.IPv6Address(match[1].strip("[]"))
    return endpoint


_TLS_WAYS = {"enable_mtls": True, "verify_name_on_connect": True, "close_link_on_expiration": True}


def client_settings(endpoint: str, folder: Path) -> dict[str, Any]:
    """A whole zenoh configuration, as JSON, for a reader or commander; the keys in `folder` are in it, base 64.

    Raises ValueError for an endpoint that is not TLS, OSError where the keys cannot be read.
    """

    def packed(name: str) -> str:
        return base64.b64encode((folder / name).read_bytes()).decode()

    return {
        "mode": "client",
        "connect": {"endpoints": [check_network_endpoint(endpoint)]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "link": {
                "protocols": ["tls"],
                "tls": _TLS_WAYS
                | {
                    "root_ca_certificate_base64": packed(CA_FILE),
                    "connect_private_key_base64": packed(KEY_FILE),
                    "connect_certificate_base64": packed(CERTIFICATE_FILE),
                },
            }
        },
    }


def network_settings(network: Network) -> dict[str, Any]:
    """Return zenoh's configuration keys for the session that listens to other machines."""
    missing = [name for name in (CA_FILE, CERTIFICATE_FILE, KEY_FILE) if not (network.keys / name).is_file()]
    if missing:
        raise ValueError(
            f"network.keys: found {network.keys} without {', '.join(missing)}, wanted a folder made by "
            "`seldinger keys issue RIG --role rig`"
        )
    return {
        "transport/link/tls": _TLS_WAYS
        | {
            "root_ca_certificate": str(network.keys / CA_FILE),
            "listen_private_key": str(network.keys / KEY_FILE),
            "listen_certificate": str(network.keys / CERTIFICATE_FILE),
        },
        "transport/unicast/max_sessions": 64,
        "access_control": access_control(network),
    }


def readable(rig: str) -> list[str]:
    """Return the keys that readers may subscribe to: every published topic by name, and all together."""
    return [key(rig, name) for name, topic in TOPICS.items() if topic.kind != "query"]


def access_control(network: Network) -> dict[str, Any]:
    """Zenoh's access control: this machine may all; a certificate may what its role and its place in the lists say.

    Readers subscribe and receive. Commanders do that too, and ask under their own name. No other client publishes, answers
    or asks: what has no rule is denied, both ways.
    """
    for name in network.readers + network.commanders:
        check_name(name)
    rules: list[dict[str, Any]] = [
        _rule(
            "local",
            [
                "put",
                "delete",
                "declare_subscriber",
                "query",
                "reply",
                "declare_queryable",
                "liveliness_token",
                "declare_liveliness_subscriber",
                "liveliness_query",
            ],
            ["ingress", "egress"],
            ["**"],
        ),
        # To subscribe is to wish: what is sent is decided by the next rule, key by key.
        _rule("subscribe", ["declare_subscriber"], ["ingress"], ["seldinger/**"]),
        _rule("receive", ["put"], ["egress"], readable(network.rig)),
    ]
    subjects: list[dict[str, Any]] = [{"id": "local", "link_protocols": ["tcp", "unixsock-stream"]}]
    policies: list[dict[str, Any]] = [{"rules": ["local"], "subjects": ["local"]}]
    for role, names in (("reader", network.readers), ("commander", network.commanders)):
        for name in names:
            subject = common_name(role, name)
            subjects.append({"id": subject, "cert_common_names": [subject], "link_protocols": ["tls"]})
            may = ["subscribe", "receive"]
            if role == "commander":
                own = [request_key(network.rig, name)]
                rules += [
                    _rule(f"ask as {name}", ["query"], ["ingress"], own),
                    _rule(f"answer {name}", ["reply", "declare_queryable"], ["egress"], own),
                ]
                may += [f"ask as {name}", f"answer {name}"]
            policies.append({"rules": may, "subjects": [subject]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


def _rule(name: str, messages: list[str], flows: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "messages": messages, "flows": flows, "key_exprs": keys}
