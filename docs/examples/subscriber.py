"""Print a rig's state as it arrives, with zenoh and msgpack alone. Argument: an endpoint, or a file of `seldinger keys`."""

import sys

import msgpack
import zenoh

CLIENT = '{mode: "client", connect: {endpoints: ["%s"], timeout_ms: -1}, scouting: {multicast: {enabled: false}}}'
where = sys.argv[1] if len(sys.argv) > 1 else "unixsock-stream//run/seldinger/zenoh.sock"
config = zenoh.Config.from_file(where) if where.endswith(".json5") else zenoh.Config.from_json5(CLIENT % where)
with zenoh.open(config) as session:
    latest = session.declare_subscriber("seldinger/v1/*/state", zenoh.handlers.RingChannel(1))
    while True:
        s = msgpack.unpackb(latest.recv().payload.to_bytes())
        print(f"{s['stamp_ns'] * 1e-9:.3f} s  {s['mode']}  {s['force_N'] or 0.0:.3f} N  {s['cause']}", flush=True)
