"""Tables that are damaged, or unpack to far more than they are: read, or refused in one line before they fill the memory."""

from __future__ import annotations

import gzip
import io
import random
import zipfile
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
import scipy.io
from mcap.writer import CompressionType, Writer

from host.diagnosis.model.tables import read_table
from protocol.errors import InputError
from tests.host.crafted_recordings import damage
from tests.host.diagnosis.crafted_tables import originals, read_one

KINDS = ("csv", "csv.gz", "parquet", "mat", "npz", "mcap")
PACKED = KINDS[1:]
LIMIT_BYTES = 100_000


def write_packed(kind: str, path: Path) -> None:
    """Write a small file that unpacks to 0.5 MB."""
    zeros = np.zeros(70_000)
    if kind == "csv.gz":
        path.write_bytes(gzip.compress(b"a,b\n" + b"0,0\n" * 125_000))
    elif kind == "parquet":
        pyarrow.parquet.write_table(pyarrow.table({"a": zeros}), path)
    elif kind == "mat":
        scipy.io.savemat(path, {"a": zeros}, do_compression=True)
    elif kind == "npz":
        np.savez_compressed(path, allow_pickle=False, a=zeros)
    else:
        with path.open("wb") as stream:
            writer = Writer(stream, compression=CompressionType.ZSTD)
            writer.start()
            channel = writer.register_channel("stage", "json", writer.register_schema("S", "jsonschema", b"{}"))
            for number in range(50):
                writer.add_message(channel, number, b'{"a": 1.0, "text": "%s"}' % (b"x" * 10_000), number, number)
            writer.finish()


@pytest.mark.parametrize("kind", PACKED)
def test_a_table_that_unpacks_to_more_than_the_limit_is_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"packed.{kind}"
    write_packed(kind, path)
    assert path.stat().st_size < 30_000
    with pytest.raises(InputError, match="which unpacks to more than"):
        read_table(path, LIMIT_BYTES)
    assert np.isfinite(read_table(path)[{"mcap": "stage.a"}.get(kind, "a")]).all(), "the default admits it"


def test_an_array_that_announces_more_than_its_file_holds_is_refused(tmp_path: Path) -> None:
    path, array = tmp_path / "announces.npz", io.BytesIO()
    np.lib.format.write_array_header_1_0(array, {"descr": "<f8", "fortran_order": False, "shape": (10**15,)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", array.getvalue())
    with pytest.raises(InputError, match="larger than its file"):
        read_table(path)


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_tables_are_read_or_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    content, path = originals(tmp_path)[kind], tmp_path / f"damaged.{kind}"
    for number in range(40):
        path.write_bytes(damage(bytearray(content), random.Random(f"{kind}/{number}")))
        read_one(path)
