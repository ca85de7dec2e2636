"""Is the keys folder that a rig file names fit to listen with? One line for each thing that is wrong."""

from __future__ import annotations

import datetime
import ipaddress
import stat
from collections.abc import Sequence
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.x509.oid import NameOID

from protocol.zenoh_access import CA_FILE, CERTIFICATE_FILE, KEY_FILE

_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def keys_problems(folder: Path, listen: Sequence[str], now: datetime.datetime | None = None) -> list[str]:
    """Return all problems of the keys in `folder` for a rig that listens on `listen`; empty if there are none.

    listen: endpoints, tls/ADDRESS:PORT. now: default, this machine's clock.
    """
    now = now or datetime.datetime.now(datetime.UTC)
    if not folder.is_dir():
        return [f"network.keys: found no folder {folder}, wanted one made by `seldinger keys issue RIG --role rig`"]
    problems: list[str] = []
    ca = _certificate(folder / CA_FILE, problems)
    own = _certificate(folder / CERTIFICATE_FILE, problems)
    key = _key(folder / KEY_FILE, problems)
    for certificate, name in ((own, CERTIFICATE_FILE), (ca, CA_FILE)):
        if certificate is not None:
            problems += _in_time(certificate, folder / name, now)
    if own is not None and ca is not None and not _issued_by(own, ca):
        problems.append(
            f"{folder / CERTIFICATE_FILE}: found a certificate of another authority, wanted one of {CA_FILE} in that folder"
        )
    if own is not None and key is not None and key != own.public_key():
        problems.append(
            f"{folder / KEY_FILE}: found the key of another certificate, wanted that of {CERTIFICATE_FILE} there"
        )
    if own is not None:
        problems += _fits_a_rig(own, folder / CERTIFICATE_FILE, listen)
    return problems


def _read(path: Path, what: str, problems: list[str]) -> bytes | None:
    try:
        return path.read_bytes()
    except OSError as error:
        problems.append(f"{path}: found {error.strerror}, wanted {what}")
    return None


def _certificate(path: Path, problems: list[str]) -> x509.Certificate | None:
    content = _read(path, "a certificate", problems)
    try:
        return None if content is None else x509.load_pem_x509_certificate(content)
    except ValueError:
        problems.append(f"{path}: found no certificate in it, wanted one in PEM")
    return None


def _key(path: Path, problems: list[str]) -> object | None:
    """The public half of the private key in `path`."""
    content = _read(path, "the certificate's private key", problems)
    if content is None:
        return None
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & _OTHERS:
        problems.append(
            f"{path}: found mode {mode:04o}, which lets others read it, wanted 0600; if it may have been read, "
            "issue a new one"
        )
    try:
        return serialization.load_pem_private_key(content, None).public_key()
    except (ValueError, TypeError):
        problems.append(f"{path}: found no private key in it, wanted one in PEM without a password")
    return None


def _in_time(certificate: x509.Certificate, path: Path, now: datetime.datetime) -> list[str]:
    if now > certificate.not_valid_after_utc:
        return [
            f"{path}: found that it expired on {certificate.not_valid_after_utc:%Y-%m-%d}, wanted a valid one; move the "
            "folder away and issue again"
        ]
    if now < certificate.not_valid_before_utc:
        return [
            f"{path}: found that it is valid from {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC, wanted one "
            "that is valid now; is this machine's clock right?"
        ]
    return []


def _issued_by(own: x509.Certificate, ca: x509.Certificate) -> bool:
    try:
        own.verify_directly_issued_by(ca)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def _fits_a_rig(own: x509.Certificate, path: Path, listen: Sequence[str]) -> list[str]:
    names = own.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    name = str(names[0].value) if names else "no name"
    if not name.startswith("rig."):
        return [f"{path}: found the certificate of {name}, wanted one issued with --role rig"]
    made_for = _addresses(own)
    problems = []
    for endpoint in listen:
        address = endpoint.removeprefix("tls/").rpartition(":")[0].strip("[]")
        if address not in made_for and not _any(address):
            problems.append(
                f"network.listen: found {endpoint}, wanted an address that the certificate was made for: "
                f"{', '.join(made_for) or 'none'}"
            )
    return problems


def _addresses(own: x509.Certificate) -> list[str]:
    try:
        names = own.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return []
    return [str(name.value) for name in names]


def _any(address: str) -> bool:
    """Whether it stands for all addresses of the machine."""
    try:
        return ipaddress.ip_address(address).is_unspecified
    except ValueError:
        return False
