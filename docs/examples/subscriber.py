"""Print a rig's state as it comes, by plain zenoh and msgpack. Argument: a zenoh configuration (none: this machine)."""
import sys

import msgpack
import zenoh

config = zenoh.Config.from_file(sys.argv[1]) if len(sys.argv) > 1 else zenoh.Config.from_json5(
    '{mode: "client", connect: {endpoints: ["tcp/127.0.0.1:7451"]}, scouting: {multicast: {enabled: false}}}')
with zenoh.open(config) as session:
    latest = session.declare_subscriber("seldinger/v1/*/state", zenoh.handlers.RingChannel(1))
    while True:
        state = msgpack.unpackb(latest.recv().payload.to_bytes())
        force = "-" if state["force_N"] is None else f"{state['force_N']:.3f} N"
        print(f"{state['stamp_ns'] * 1e-9:.3f} s  {state['mode']}  {force}  {state['cause']}", flush=True)
