"""`seldinger keys`: the laboratory's certificate authority, certificates for rig, readers and commanders."""

from __future__ import annotations

import datetime
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json
from protocol.errors import Description, InputError, reason

keys = typer.Typer(help="Certificates for access from other machines (docs/security.md).", no_args_is_help=True)
Directory = Annotated[Path, typer.Option("--directory", "-d", help="Folder of authority and certificates.")]
PassphraseFile = Annotated[Path | None, typer.Option(help="File with the passphrase of the authority's key, on one line.")]
KEYS = Path("keys")
EXPIRES_SOON = datetime.timedelta(days=30)


@keys.callback()
def _group() -> None:
    """Certificates for access from other machines."""


@keys.command()
def init(
    directory: Directory = KEYS,
    laboratory: Annotated[str, typer.Option(help="Name of the laboratory, for the authority's certificate.")] = "laboratory",
    passphrase: Annotated[bool, typer.Option("--passphrase", help="Ask for a passphrase that encrypts the key.")] = False,
    passphrase_file: PassphraseFile = None,
    json: Json = False,
) -> None:
    """Make the laboratory's authority. Refused if there is one, because all its certificates would become invalid."""
    from host.security.keys import make_authority

    secret = _read_passphrase(passphrase_file) if passphrase_file is not None else ""
    if passphrase and not secret:
        secret = typer.prompt("Passphrase of the authority's key", hide_input=True, confirmation_prompt=True, err=True)
    if not 0 < len(laboratory.strip()) <= 60:
        raise InputError("--laboratory", laboratory, "1 to 60 characters")
    folder = make_authority(directory, laboratory, secret)
    print(
        f"authority in {folder}; its key.pem allows commands to every rig: keep it off the rigs, and back it up",
        file=sys.stderr,
    )
    if json:
        write_json({"authority": str(folder)})


@keys.command()
def issue(
    name: Annotated[str, typer.Argument(help="Name of the rig's machine, the reader or the commander: a-z, 0-9, - and _.")],
    role: Annotated[str, typer.Option(help="rig (the machine that listens), reader, or commander (reads too).")],
    directory: Directory = KEYS,
    address: Annotated[
        list[str] | None, typer.Option(help="For a rig: its IP address or host name; may be given several times.")
    ] = None,
    connect: Annotated[str, typer.Option(help="For a reader or commander: the rig, as tls/ADDRESS:PORT.")] = "",
    days: Annotated[int, typer.Option(help="Number of days for which the certificate is valid.")] = 365,
    passphrase_file: PassphraseFile = None,
    json: Json = False,
) -> None:
    """Issue a key and a certificate, in a folder to be copied to that machine; print the lines that the rig file needs."""
    from host.security.keys import CLIENT_FILE, has_passphrase, network_lines
    from host.security.keys import issue as issue_certificate

    addresses = address or []
    secret = _read_passphrase(passphrase_file) if passphrase_file is not None else ""
    if not secret and has_passphrase(directory):
        if not sys.stdin.isatty():
            raise InputError(
                "--passphrase-file", Description("nothing"), "a file with the passphrase of the authority's key"
            )
        secret = typer.prompt("Passphrase of the authority's key", hide_input=True, err=True)
    one = issue_certificate(directory, name, role, addresses=addresses, days=days, connect=connect, passphrase=secret)
    print(f"{one.folder}: {one.role} {one.name}, serial {one.serial}, until {one.expires:%Y-%m-%d}", file=sys.stderr)
    if connect:
        print(
            f"{one.folder / CLIENT_FILE}: the only file that the other machine needs; it contains key and certificate",
            file=sys.stderr,
        )
    print("lines for the rig file, for all certificates issued here:", file=sys.stderr)
    port = connect or (f"tls/{_bracketed(addresses[0])}:7448" if addresses else "")
    lines = network_lines(directory, port)
    if json:
        write_json({"folder": str(one.folder), "rig_file_lines": lines})
    else:
        print(lines, end="")


def _read_passphrase(path: Path) -> str:
    """The first line of a file. Raises InputError where there is none, or others can read the file."""
    try:
        if path.stat().st_mode & 0o077:
            raise InputError("--passphrase-file", str(path), "a file that only its user can read (chmod 600)")
        line = path.read_text(encoding="utf-8").partition("\n")[0]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("--passphrase-file", reason(error), "a readable file") from None
    if not line:
        raise InputError("--passphrase-file", str(path), "a file with a passphrase on its first line")
    return line


@keys.command()
def show(directory: Directory = KEYS, json: Json = False) -> None:
    """List all certificates: name, role, expiry. Exit status 1 when one has expired."""
    from host.security.keys import issued

    now = datetime.datetime.now(datetime.UTC)
    found = issued(directory)
    if json:
        write_json({"certificates": [_row(one, now) for one in found]})
    else:
        from rich.console import Console
        from rich.table import Table

        table = Table("name", "role", "serial", "until", "", box=None, padding=(0, 2, 0, 0))
        for one in found:
            table.add_row(one.name, one.role, one.serial, f"{one.expires:%Y-%m-%d}", _row(one, now)["state"])
        Console(highlight=False).print(table)
    if any(one.expires < now for one in found):
        raise typer.Exit(1)


def _row(one: Any, now: datetime.datetime) -> dict[str, str]:
    state = "expired" if one.expires < now else "expires soon" if one.expires < now + EXPIRES_SOON else "valid"
    return {"name": one.name, "role": one.role, "serial": one.serial, "until": one.expires.isoformat(), "state": state}


def _bracketed(address: str) -> str:
    return f"[{address}]" if ":" in address else address
