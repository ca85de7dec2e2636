"""Crafted and damaged tables of every kind, for the tests and for `make fuzz-files`.

`python -m tests.host.diagnosis.crafted_tables 5000 [SEED]` reads that many; the first that does anything but read or raise
InputError of one line ends it, and is kept in build/crafted_tables.
"""

from __future__ import annotations

import gzip
import random
import resource
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.csv
import pyarrow.parquet
import scipy.io
from mcap.writer import CompressionType

from host.diagnosis.model.tables import read_table
from protocol.errors import InputError
from tests.host.crafted_recordings import damage, foreign

CORPUS = Path("build/crafted_tables")


def originals(folder: Path) -> dict[str, bytes]:
    """Return ending -> a table of that kind, packed and not."""
    rows = np.arange(200.0)
    columns = {"time_s": 0.01 * rows, "a": np.sin(rows), "b": rows % 7}
    table = pyarrow.table(columns)
    paths = {kind: folder / f"original.{kind}" for kind in ("csv", "csv.gz", "parquet", "mat", "npz")}
    pyarrow.csv.write_csv(table, paths["csv"])
    paths["csv.gz"].write_bytes(gzip.compress(paths["csv"].read_bytes()))
    pyarrow.parquet.write_table(table, paths["parquet"])
    scipy.io.savemat(paths["mat"], columns, do_compression=True)
    np.savez_compressed(paths["npz"], allow_pickle=False, **columns)
    found = {kind: path.read_bytes() for kind, path in paths.items()}
    return {**found, "mcap": foreign(CompressionType.ZSTD)}


def read_one(path: Path) -> None:
    """Read a table; an InputError of one line is an answer too."""
    try:
        read_table(path)
    except InputError as error:
        assert "\n" not in str(error) and len(str(error)) < 600, str(error)


def main() -> int:
    """Read many crafted tables; 0 when each was read or refused in one line."""
    count, seed = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1
    CORPUS.mkdir(parents=True, exist_ok=True)
    files = originals(CORPUS)
    begin_s, before_kib = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in range(count):
        chance = random.Random(f"{seed}/{number}")
        kind = chance.choice(sorted(files))
        path = CORPUS / f"newest.{kind}"
        path.write_bytes(damage(bytearray(files[kind]), chance))
        try:
            read_one(path)
        except BaseException:
            path.rename(CORPUS / f"kept-{seed}-{number}.{kind}")
            print(f"table {number} of seed {seed} is kept in {CORPUS}", file=sys.stderr)
            raise
    grown_MiB = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib) / 1024
    took_s = time.monotonic() - begin_s
    print(f"{count} tables read or refused in one line, {grown_MiB:.0f} MiB grown, {took_s:.0f} s")
    return 0 if grown_MiB < 1024 else 1


if __name__ == "__main__":
    sys.exit(main())
