"""The declaration of the tick's records: every field has a meaning, and the page of the documentation follows from it."""

from pathlib import Path

import numpy as np
import pytest

from realtime.control import records
from realtime.control.declare import as_markdown, dtype_of, fields_of

DECLARED = [one for one in vars(records).values() if isinstance(one, type) and one.__module__ == records.__name__]
# Suffixes of names that say what a field's unit is.
UNITS = {
    "_ns": "ns",
    "_us": "us",
    "_m": "m",
    "_N": "N",
    "_rad": "rad",
    "_Hz": "Hz",
    "_N2": "N^2",
    "_m2": "m^2",
    "_per_m": "1/m",
}


@pytest.mark.parametrize("record", DECLARED)
def test_every_field_has_a_type_a_meaning_and_the_unit_that_its_name_says(record: type) -> None:
    fields = fields_of(record)
    assert list(fields) == [name for name in record.__annotations__], "every annotated field is declared"
    assert (record.__doc__ or "").strip()
    for name, field in fields.items():
        assert len(field.doc) > 5 and "|" not in field.doc, name
        suffix = next((s for s in sorted(UNITS, key=len, reverse=True) if name.endswith(s) and "_per_" not in name), "")
        if suffix:
            assert field.unit == UNITS[suffix], f"{record.__name__}.{name}: found {field.unit}"


def test_the_dtype_has_the_declared_fields_and_shapes() -> None:
    dtype = dtype_of(records.Inputs)
    assert dtype == records.INPUTS and dtype.names == tuple(fields_of(records.Inputs))
    assert dtype["estimate"]["covariance_N2"].shape == (3, 3) and dtype["now_ns"] == np.dtype("i8")


def test_the_page_is_the_declaration() -> None:
    page = (Path(__file__).parent.parent.parent / "docs" / "records.md").read_text(encoding="utf-8")
    assert page == records.page(), (
        "docs/records.md: found another table, wanted that of `python -m realtime.control.records`"
    )


def test_a_nested_record_has_one_table() -> None:
    assert as_markdown(records.Params).count("## TargetParams") == 1
