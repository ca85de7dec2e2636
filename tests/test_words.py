"""The words of documents, docstrings, comments and messages: words that docs/glossary.md replaces do not return."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
DOCUMENTS = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")] + sorted(ROOT.glob("docs/**/*.md"))
SOURCES = sorted(
    path for room in ("host", "realtime", "protocol", "sim", "seldinger") for path in (ROOT / room).rglob("*.py")
)
TEMPLATES = sorted((ROOT / "host").rglob("*.j2")) + sorted((ROOT / "host" / "view" / "static").glob("*.html"))

# What is replaced -> what is said instead. Only words that have no right use in this project.
REPLACED = {
    r"foret(?:ell|old)\w*|forecast\w*": "predict, prediction",
    r"in silence": "without a warning",
    r"(?:cannot|can not) be told|told from|tell\w* apart|told apart": "indistinguishable, separate",
    r"as well may|may as well": "indistinguishable from",
    r"whoever|nobody|somebody|anybody": "name the program or the person",
    r"stand-ins?": "wrong name, effect of the same family",
    r"parted": "differ, disagree",
    r"beside": "relative to, compared with, next to, together with",
    r"besides": "also, and",
    r"pool": "candidate effects",
    r"what is left": "residual, remaining",
    r"(?<!control )desk": "command handling",
    r"un?heard|heard": "received",
    r"anew": "again",
    r"asked for": "requested",
    r"believed?|believes": "estimated, assumed",
    r"the play\b(?! operator)|play of": "backlash",
    r"nominal chain": "nominal model",
    r"mend(?:s|ed|ing)?": "correct, repair",
    r"(?:the|command's) contract": "name the document or the command that prints it",
    r"(?<!there )(?:is|are|was|were) no (?!longer|tip|answer|\w+er\b|more|less|better|worse)\w+": "is not a",
    r"(?<!there )(?:is|are|was|were) none of|none of nature": "is not one of",
    r"vouch\w*": "confirm, state",
    r"to blame": "name the cause",
}
# Parts of names in code that are metaphors or replaced words.
NAME_PARTS = set(
    "desk dish heard hearing hears told telling tells foretold foretell believed whoever nobody somebody people".split()
)
PATTERN = re.compile("|".join(rf"(?P<w{index}>\b(?:{words})\b)" for index, words in enumerate(REPLACED)), re.IGNORECASE)
INSTEAD = list(REPLACED.values())


def found_in(text: str) -> list[str]:
    """Each replaced word of `text` with what to say instead."""
    text = re.sub(r"\s+", " ", text)  # two words may stand in two lines
    return [f'"{m.group()}": say {INSTEAD[int((m.lastgroup or "w0")[1:])]}' for m in PATTERN.finditer(text)]


def prose_of(document: str) -> str:
    """A document without code, links' targets, generated sections and the table of replaced words."""
    text = re.sub(r"<!-- (\w[\w-]*):? begin -->.*?<!-- \1:? end -->", "", document, flags=re.DOTALL)
    text = re.sub(r"## Words that are replaced.*", "", text, flags=re.DOTALL)
    text = re.sub(r"^(?:```|    ).*?(?:```$|$)", "", text, flags=re.MULTILINE)
    return re.sub(r"`[^`]*`|\]\([^)]*\)", "", text)


def strings_of(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of every string with a space (messages, help texts, docstrings) and of every comment."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.lineno, node.value
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def named(path: Path) -> str:
    """Name of a file in the output of pytest."""
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_documents_use_the_glossary(document: Path) -> None:
    assert found_in(prose_of(document.read_text(encoding="utf-8"))) == []


def test_strings_use_the_glossary() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {fault}"
        for path in SOURCES
        for line, text in strings_of(path.read_text(encoding="utf-8"))
        for fault in found_in(re.sub(r"`[^`]*`", "", text))
    ]
    assert found == []


def test_names_use_the_glossary() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{token.start[0]}: {token.string}"
        for path in SOURCES
        for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline)
        if token.type == tokenize.NAME
        and NAME_PARTS & {part.lower() for part in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", token.string)}
    ]
    assert found == []


@pytest.mark.parametrize("template", TEMPLATES, ids=named)
def test_templates_use_the_glossary(template: Path) -> None:
    text = re.sub(r"<(style|script)\b.*?</\1>|\{[{%].*?[%}]\}|<[^>]*>", "", template.read_text(), flags=re.DOTALL)
    assert found_in(text) == []


def test_replaced_words_are_found() -> None:
    assert found_in("The beat is foretold.") == ['"foretold": say predict, prediction']
    assert found_in("play operator, recorded, holds, displays, unheard-of") == ['"unheard": say received']
    assert found_in("a step is no\n    noise; there is no noise; it is no longer one") == ['"is no noise": say is not a']
    assert found_in(prose_of("`beside`\n\n    seldinger beside\n\nsee [it](beside.md)")) == []
