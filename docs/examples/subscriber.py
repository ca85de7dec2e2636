"""Print a rig's state as it comes, by plain zenoh and msgpack. Argument: an endpoint, or a file from `seldinger keys`."""

import sys

import msgpack
import zenoh

where = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7451"
config = (
    zenoh.Config.from_file(where)
    if where.endswith(".json5")
    else zenoh.Config.from_json5(
        '{mode: "client", connect: {endpoints: ["HERE"], timeout_ms: -1}, scouting: {multicast: {enabled: false}}}'.replace(
            "HERE", where
        )
    )
)
with zenoh.open(config) as session:
    latest = session.declare_subscriber("seldinger/v1/*/state", zenoh.handlers.RingChannel(1))
    while True:
        s = msgpack.unpackb(latest.recv().payload.to_bytes())
        print(f"{s['stamp_ns'] * 1e-9:.3f} s  {s['mode']}  {s['force_N'] or 0.0:.3f} N  {s['cause']}", flush=True)
