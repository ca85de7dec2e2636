"""docs/recordings.md, the data dictionary: it is the one that the code prints, and leaves no column out."""

from __future__ import annotations

from pathlib import Path

from host.recordings.dictionary import MEANINGS, SPATIAL_UNITS, WITHOUT_FRAME, as_markdown, recorded_topics
from protocol.messages import columns, specs

PAGE = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text(encoding="utf-8")


def test_the_page_is_current() -> None:
    assert as_markdown() in PAGE, "docs/recordings.md: print its tables again with `python -m host.recordings.dictionary`"


def test_every_field_with_a_place_or_direction_has_a_frame_and_an_owner() -> None:
    spatial = {
        (topic.name, field)
        for topic in recorded_topics()
        for field, spec in specs(topic.message).items()
        if spec.kind == "float" and (spec.columns or spec.unit in SPATIAL_UNITS) and (topic.name, field) not in WITHOUT_FRAME
    }
    assert spatial == set(MEANINGS)


def test_every_column_of_every_topic_is_on_the_page() -> None:
    for topic in recorded_topics():
        section = PAGE.partition(f"### `{topic.name}`")[2].partition("###")[0]
        for column, spec in columns(topic.message).items():
            if not column.startswith("tick_bucket_"):
                assert f"| `{column}` | {spec.unit or '-'} |" in section, (topic.name, column)
