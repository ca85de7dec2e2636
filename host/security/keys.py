"""The laboratory's own certificates: one authority, a folder for each holder, and zenoh's settings for them."""

from __future__ import annotations

import datetime
import ipaddress
import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from protocol.errors import Description, InputError
from protocol.topics import check_name
from protocol.zenoh_access import (
    CA_FILE,
    CERTIFICATE_FILE,
    KEY_FILE,
    ROLES,
    check_network_endpoint,
    client_settings,
    common_name,
)

CA_FOLDER = "authority"
CA_YEARS = 10
DAYS = 365
CLIENT_FILE = "zenoh.json5"
# Certificates are valid from a little before they are made: clocks differ.
_BACKDATED = datetime.timedelta(hours=1)
_HOST_NAME = re.compile(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?(\.[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?)*", re.IGNORECASE)


@dataclass(frozen=True)
class Issued:
    """One certificate of the laboratory: whose, for what, which, and until when."""

    name: str
    role: str
    serial: str
    expires: datetime.datetime
    folder: Path


def make_authority(directory: Path, laboratory: str = "laboratory", passphrase: str = "") -> Path:
    """A new authority in `directory`: its certificate, and its key, which never leaves the folder (0600).

    passphrase: with one the key is encrypted, and every later use needs it.

    Raises InputError where there is one already: all certificates of the old one would be worthless.
    """
    folder = directory / CA_FOLDER
    if folder.exists():
        raise InputError("directory", f"an authority in {folder}", "a directory without one; move it away to start again")
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATION_NAME, laboratory[:60]),
            x509.NameAttribute(NameOID.COMMON_NAME, "seldinger authority"),
        ]
    )
    builder = _builder(name, name, key.public_key(), datetime.timedelta(days=365 * CA_YEARS))
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    builder = builder.add_extension(_usage(signs_certificates=True), critical=True)
    certificate = builder.sign(key, hashes.SHA256())
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("directory", str(directory), f"a folder that can be made ({error.strerror})") from None
    _make_private(folder)
    _write(folder / KEY_FILE, _key_pem(key, passphrase), 0o600)
    _write(folder / CA_FILE, certificate.public_bytes(serialization.Encoding.PEM), 0o644)
    return folder


def has_passphrase(directory: Path) -> bool:
    """Whether the key of the authority in `directory` is encrypted."""
    try:
        return b"ENCRYPTED" in (directory / CA_FOLDER / KEY_FILE).read_bytes()
    except OSError:
        return False


def issue(
    directory: Path,
    name: str,
    role: str,
    *,
    addresses: Sequence[str] = (),
    days: int = DAYS,
    connect: str = "",
    passphrase: str = "",
) -> Issued:
    """A key and a certificate for `name` in a folder of its own: what that machine needs, and nothing else.

    role: `rig` for the machine that listens, at `addresses` (IP addresses and host names by which others reach it);
    `reader` or `commander` for the others. connect: the rig's endpoint, `tls/ADDRESS:PORT`; with it the folder gets a
    zenoh configuration that holds all of it (0600). passphrase: of the authority's key.

    Raises InputError: no authority, a wrong passphrase, a bad name or role or address, a folder that is there already.
    """
    _check(name, role, addresses, days)
    ca_key, ca = _authority(directory, passphrase)
    folder = directory / name
    _check_connect(connect)
    if folder.exists():
        raise InputError("name", f"{name}, which has a folder {folder}", "a new name, or that folder moved away")
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, role),
            x509.NameAttribute(NameOID.COMMON_NAME, common_name(role, name)),
        ]
    )
    builder = _builder(subject, ca.subject, key.public_key(), _life(days, ca))
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    builder = builder.add_extension(_usage(signs_certificates=False), critical=True)
    builder = builder.add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(ca_key.public_key()), critical=False)
    purpose = ExtendedKeyUsageOID.SERVER_AUTH if role == "rig" else ExtendedKeyUsageOID.CLIENT_AUTH
    builder = builder.add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
    if addresses:
        builder = builder.add_extension(x509.SubjectAlternativeName([_alternative(a) for a in addresses]), critical=False)
    certificate = builder.sign(ca_key, hashes.SHA256())
    _make_private(folder)
    _write(folder / KEY_FILE, _key_pem(key), 0o600)
    _write(folder / CERTIFICATE_FILE, certificate.public_bytes(serialization.Encoding.PEM), 0o644)
    _write(folder / CA_FILE, ca.public_bytes(serialization.Encoding.PEM), 0o644)
    if connect:
        _write(folder / CLIENT_FILE, (json.dumps(client_settings(connect, folder), indent=2) + "\n").encode(), 0o600)
    return _issued(folder, certificate)


def issued(directory: Path) -> list[Issued]:
    """Return all certificates in `directory`, by name. Raises InputError if one cannot be read."""
    if not directory.is_dir():
        raise InputError("directory", str(directory), "a folder that `seldinger keys init` made")
    found = []
    for path in sorted(directory.glob(f"*/{CERTIFICATE_FILE}")):
        try:
            found.append(_issued(path.parent, x509.load_pem_x509_certificate(path.read_bytes())))
        except (ValueError, OSError) as error:
            raise InputError(str(path), str(error)[:80], "a certificate") from None
    return found


def network_lines(directory: Path, listen: str = "") -> str:
    """The rig file's section [network] for what `directory` has issued. listen: the rig's endpoint, if known."""
    names = {role: [one.name for one in issued(directory) if one.role == role] for role in ROLES}
    rig = names["rig"][0] if names["rig"] else "RIG"
    return "\n".join(
        [
            "[network]",
            f"listen = {json.dumps([listen or 'tls/ADDRESS:7448'])}",
            f"keys = {json.dumps(str((directory / rig).resolve()))}",
            "peers = []",
            f"readers = {json.dumps(names['reader'])}",
            f"commanders = {json.dumps(names['commander'])}",
            "",
        ]
    )


def _check_connect(connect: str) -> None:
    try:
        if connect:
            check_network_endpoint(connect)
    except ValueError:
        raise InputError("connect", connect[:60], "tls/ADDRESS:PORT") from None


def _check(name: str, role: str, addresses: Sequence[str], days: int) -> None:
    try:
        check_name(name)
    except ValueError:
        raise InputError("name", name[:40], "1 to 32 of a-z, 0-9, - and _") from None
    if name == CA_FOLDER:
        raise InputError("name", name, "another name: that folder is the authority's")
    if role not in ROLES:
        raise InputError("role", role[:40], f"one of {', '.join(ROLES)}")
    if (role == "rig") != bool(addresses):
        raise InputError(
            "address",
            ", ".join(addresses) or "none",
            "at least one for the role rig" if role == "rig" else f"none for the role {role}",
        )
    if not 1 <= days <= 3650:
        raise InputError("days", str(days), "1 to 3650")
    for address in addresses:
        _alternative(address)


def _alternative(address: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        if not _HOST_NAME.fullmatch(address) or len(address) > 253 or address.replace(".", "").isdigit():
            raise InputError("address", address[:60], "an IP address or a host name") from None
        return x509.DNSName(address)


def _authority(directory: Path, passphrase: str) -> tuple[ec.EllipticCurvePrivateKey, x509.Certificate]:
    folder = directory / CA_FOLDER
    encrypted = has_passphrase(directory)
    if encrypted and not passphrase:
        raise InputError("passphrase", Description("none"), "that of the authority's key, which is encrypted")
    try:
        key_bytes = (folder / KEY_FILE).read_bytes()
        key = serialization.load_pem_private_key(key_bytes, passphrase.encode() if encrypted else None)
        ca = x509.load_pem_x509_certificate((folder / CA_FILE).read_bytes())
    except (OSError, ValueError, TypeError) as error:
        if encrypted and isinstance(error, ValueError):
            found = Description("one that does not open the key")
            raise InputError("passphrase", found, "that of the authority's key") from None
        raise InputError(
            "directory", f"no authority in {folder} ({str(error)[:80]})", "one made by `seldinger keys init`"
        ) from None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != ca.public_key():
        raise InputError("directory", f"a key in {folder} that is not the certificate's", "the two of one authority")
    return key, ca


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, life: datetime.timedelta
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(now + life)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _life(days: int, ca: x509.Certificate) -> datetime.timedelta:
    """Return the smaller of `days` and the remaining validity of the authority."""
    return min(datetime.timedelta(days=days), ca.not_valid_after_utc - datetime.datetime.now(datetime.UTC))


def _usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _issued(folder: Path, certificate: x509.Certificate) -> Issued:
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    role, _, name = str(names[0].value if names else "").partition(".")
    return Issued(name, role, f"{certificate.serial_number:x}", certificate.not_valid_after_utc, folder)


def _key_pem(key: ec.EllipticCurvePrivateKey, passphrase: str = "") -> bytes:
    protection: serialization.KeySerializationEncryption = serialization.NoEncryption()
    if passphrase:
        protection = serialization.BestAvailableEncryption(passphrase.encode())
    return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, protection)


def _make_private(folder: Path) -> None:
    folder.mkdir(mode=0o700)


def _write(path: Path, content: bytes, mode: int) -> None:
    """Write a new file, never an existing one, with `mode` from the start."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(content)
