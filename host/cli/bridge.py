"""`seldinger bridge igtl|ros2`: the running rig for other systems, until Ctrl-C."""

from __future__ import annotations

import contextlib
import re
import sys
from typing import Annotated

import typer

from host.cli.contract_io import write_json
from host.cli.options import Json, RigFile
from protocol.end_signals import EndSignals
from protocol.errors import InputError
from protocol.rig_file import SIMULATED_RIG, Rig, load_rig

bridge = typer.Typer(
    help="Send the running rig's poses and forces to other systems: OpenIGTLink, ROS 2.", no_args_is_help=True
)


@bridge.callback()
def _group() -> None:
    """Hold the commands `igtl` and `ros2`."""


@bridge.command()
def igtl(
    rig: RigFile = SIMULATED_RIG,
    port: Annotated[int, typer.Option(min=1024, max=65535, help="TCP port.")] = 18944,
    address: Annotated[str, typer.Option(help="Address to listen at; 0.0.0.0 lets other machines read.")] = "127.0.0.1",
    json: Json = False,
) -> None:
    """Serve poses (TRANSFORM), forces (NDARRAY, STRING) and state (STRING) over OpenIGTLink. Nothing is commanded."""
    from host.run.igtl_bridge import IgtlBridge
    from protocol.zenoh_session import Session

    read = load_rig(rig)
    with Session.of_rig(read) as session:
        try:
            served = IgtlBridge(session, (address, port))
        except OSError as error:
            raise InputError(
                "--address, --port", f"{address}:{port}", f"an address and a free port ({error.strerror or error})"
            ) from None
        with contextlib.closing(served):
            _say(f"rig {read.name} over OpenIGTLink at {address}:{port}  (Ctrl-C ends it)")
            _note_missing_rig(read)
            if json:
                write_json({"address": address, "port": port})
                sys.stdout.flush()
            served.serve(EndSignals().asked, _say)


@bridge.command()
def ros2(
    rig: RigFile = SIMULATED_RIG,
    router: Annotated[str, typer.Option(help="Zenoh endpoint of rmw_zenohd.")] = "tcp/127.0.0.1:7447",
    namespace: Annotated[str, typer.Option(help="ROS namespace of the topics.")] = "seldinger",
    domain: Annotated[int, typer.Option(min=0, max=232, help="ROS_DOMAIN_ID.")] = 0,
    commands: Annotated[bool, typer.Option("--commands", help="Accept force commands (servo_cf) during a touch.")] = False,
    json: Json = False,
) -> None:
    """Publish measured_cp, measured_cf and operating_state (CRTK) to ROS 2 over rmw_zenoh."""
    from host.run.connection import connect
    from host.run.ros_bridge import PUBLISHED, RosBridge

    if not re.fullmatch(r"[a-z][a-z0-9_]*(/[a-z][a-z0-9_]*)*", namespace):
        raise InputError("--namespace", namespace, "names of a-z, 0-9 and _, joined by /, without a first /")
    with connect(load_rig(rig), "ros2") as connection:
        with contextlib.closing(
            RosBridge(connection, router, namespace=namespace, domain=domain, commands=commands)
        ) as served:
            names = [f"/{namespace}/{topic.name}" for topic in PUBLISHED.values()]
            _say(f"rig {connection.rig.name} to ROS 2 by {router}: {', '.join(names)}  (Ctrl-C ends it)")
            _note_missing_rig(connection.rig)
            if json:
                write_json({"topics": names, "commands": commands})
                sys.stdout.flush()
            served.serve(EndSignals().asked, _say)


def _say(text: str) -> None:
    print(f"seldinger bridge: {text}", file=sys.stderr, flush=True)


def _note_missing_rig(rig: Rig) -> None:
    """Say that the rig does not run yet: the bridge serves nothing until it does."""
    from host.run.connection import may_run

    if not may_run(rig):
        _say(f"no rig {rig.name} runs at {rig.local.folder} yet; its messages are served once it does")
