"""A recording as tables: one Parquet or CSV file for each topic, units kept."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from host.recordings.recording import RecordingFile

FORMATS = ("parquet", "csv")


def arrow_table(recording: RecordingFile, topic: str) -> pa.Table:
    """Return the table of `topic`, with units as metadata of the fields and run, configuration, catheter of the table."""
    units = recording.units(topic)
    columns = recording.table(topic)
    schema = pa.schema(
        [
            pa.field(
                name,
                pa.from_numpy_dtype(values.dtype) if values.dtype.kind != "U" else pa.string(),
                metadata={"unit": units[name]},
            )
            for name, values in columns.items()
        ],
        metadata={
            "topic": topic,
            "run": json.dumps(recording.run),
            "configuration": json.dumps(recording.configuration),
            "catheter": json.dumps(recording.catheter),
        },
    )
    return pa.table([pa.array(values) for values in columns.values()], schema=schema)


def export(recording: RecordingFile, form: str, folder: Path) -> list[Path]:
    """One file a topic, named after it (`pose/tip` gives pose_tip.parquet), into `folder`, which is made if need be.

    form: one of FORMATS. A CSV cannot carry units: units.json next to it does, topic -> column -> unit; NaN is an empty
    cell. Returns the files written. Raises ValueError for an unknown format, OSError where it cannot write.
    """
    if form not in FORMATS:
        raise ValueError(f"to: found {form!r}, wanted one of {', '.join(FORMATS)}")
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for topic in sorted(recording.topics):
        table = arrow_table(recording, topic)
        target = folder / f"{topic.replace('/', '_')}.{form}"
        if form == "parquet":
            pyarrow.parquet.write_table(table, target, compression="zstd")
        else:
            pyarrow.csv.write_csv(_nan_to_empty(table), target)
        written.append(target)
    if form == "csv":
        units = {topic: recording.units(topic) for topic in sorted(recording.topics)}
        header = {"run": recording.run, "configuration": recording.configuration, "catheter": recording.catheter}
        for name, content in (("units.json", units), ("header.json", header)):
            (folder / name).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
            written.append(folder / name)
    return written


def _nan_to_empty(table: pa.Table) -> pa.Table:
    for index, field in enumerate(table.schema):
        if pa.types.is_floating(field.type):
            values = pa.array(table.column(index).to_numpy(), from_pandas=True)
            table = table.set_column(index, field, values)
    return table
