"""The documents agree with the tree: links resolve, named files exist, commands and their options exist."""

from __future__ import annotations

import re
import shlex
from functools import cache
from pathlib import Path

import click
import pytest
import typer

from host.cli.main import COMMANDS, build
from protocol.topics import TOPICS

ROOT = Path(__file__).parent.parent
DOCUMENTS = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")] + sorted(ROOT.glob("docs/**/*.md"))
ROOMS = ("host", "realtime", "protocol", "sim", "firmware", "tests", "docs", "seldinger", ".ci")
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
SPAN = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
COMMAND = re.compile(r"^(?:\$ )?(?:sudo )?(?:\.venv/bin/)?(seldinger|python|pytest|make)\s")
WRITTEN_BY_A_USER = {"lab.toml", "mine.toml", "my_rig.toml"}
ORIGINALS = [path for path in ROOT.rglob("*.*") if not {".venv", ".git", "build"} & set(path.relative_to(ROOT).parts)]
NAMES = {path.name for path in ORIGINALS}


def code_of(text: str) -> list[str]:
    """Lines of code blocks (fenced with ``` or indented by four spaces) and code spans of running text."""
    found: list[str] = []
    fenced, previous_blank, previous = False, True, ""
    for line in text.splitlines():
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif fenced or (line.startswith("    ") and (previous_blank or found[-1:] == [previous])):
            found.append(line.strip())
        else:
            found += SPAN.findall(line)
        previous_blank, previous = not line.strip(), line.strip()
    return found


def commands_of(text: str) -> list[str]:
    """Code of `text` that is a command line of this project, without comments and shell tails."""
    lines = [re.split(r"\s#\s|\s[|<>]\s|;\s", code)[0].strip() for code in code_of(text)]
    parts = [part.strip().removeprefix("$ ") for line in lines for part in line.split("&&")]
    return [part for part in parts if COMMAND.match(part)]


def words_of(command: str) -> list[str]:
    """The words of a command line; quotes that a document shortens count as letters."""
    plain = command.replace("sudo ", "").replace(".venv/bin/", "")
    try:
        return shlex.split(plain)
    except ValueError:
        return plain.split()


@cache
def application(name: str) -> click.Command:
    """The click command `seldinger name`."""
    group = typer.main.get_command(build([name]))
    return group.commands[name]  # type: ignore[attr-defined, no-any-return]


@cache
def make_targets() -> set[str]:
    """Targets of the Makefile."""
    return set(re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))


def options_of(command: click.Command) -> set[str]:
    """Every spelling of every option of `command`."""
    return {"--help"} | {name for item in command.params for name in (*item.opts, *item.secondary_opts)}


def faults_of_seldinger(words: list[str]) -> list[str]:
    """What is wrong with a `seldinger` command line."""
    if words[1].startswith("-"):
        return [] if words[1] in ("--help", "--version") else [f"no option {words[1]}"]
    if words[1] not in COMMANDS:
        return [f"no command {words[1]}"]
    command = application(words[1])
    rest = words[2:]
    while rest and rest[0] in getattr(command, "commands", {}):
        command, rest = command.commands[rest[0]], rest[1:]  # type: ignore[attr-defined]
    if hasattr(command, "commands") and rest and not rest[0].startswith("-"):
        return [f"no command {words[1]} {rest[0]}"]
    named = {word.split("=")[0].strip("[]") for word in rest if word.strip("[").startswith("--")}
    return [f"{words[1]} has no option {name}" for name in sorted(named - options_of(command))]


def faults_of_python(words: list[str]) -> list[str]:
    """What is wrong with a `python` command line: the module or file is missing, or does not name an option."""
    if words[1] == "-m":
        path = ROOT / (words[2].replace(".", "/") + ".py")
        path = path if path.exists() else ROOT / words[2].replace(".", "/") / "__main__.py"
        rest = words[3:]
    else:
        path, rest = ROOT / words[1], words[2:]
    if words[1] == "-m" and words[2].split(".")[0] not in ROOMS:
        return []
    if not path.exists():
        return [f"no file {path.relative_to(ROOT)}"]
    source = path.read_text(encoding="utf-8")
    named = {word.split("=")[0] for word in rest if word.startswith("--")}
    return [f"{path.name} has no option {name}" for name in sorted(named) if f'"{name}"' not in source]


def faults_of_pytest(words: list[str]) -> list[str]:
    """What is wrong with a `pytest` command line: a path is missing, or `-k` selects nothing by name."""
    paths = [word.split("::")[0] for word in words[1:] if word.startswith("tests")]
    files = [file for path in paths for file in sorted(ROOT.glob(path))]
    faults = [f"no file {path}" for path in paths if not list(ROOT.glob(path))]
    if "-k" in words and files:
        wanted = words[words.index("-k") + 1]
        sources = [file for item in files for file in ([item] if item.is_file() else item.rglob("test_*.py"))]
        if not any(re.search(rf"def test_\w*{wanted}", file.read_text(encoding="utf-8")) for file in sources):
            faults.append(f"no test named by -k {wanted}")
    return faults


def faults_of_make(words: list[str]) -> list[str]:
    """What is wrong with a `make` command line: an unknown target of the Makefile."""
    if "-C" in words:
        return [] if (ROOT / words[words.index("-C") + 1]).is_dir() else [f"no folder {words}"]
    return [f"no target {word}" for word in words[1:] if "=" not in word and word not in make_targets()]


CHECKS = {
    "seldinger": faults_of_seldinger,
    "python": faults_of_python,
    "pytest": faults_of_pytest,
    "make": faults_of_make,
}


def faults_of(command: str) -> list[str]:
    """What is wrong with a command line of a document."""
    words = [word for word in words_of(command) if word not in ("…", "...")]
    return CHECKS[words[0]](words) if len(words) > 1 else []


def anchor_of(heading: str) -> str:
    """The anchor that a heading gets on the usual hosts."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def missing_files(text: str) -> list[str]:
    """Files that code spans name by a path in a room, or by a bare name with a source's ending, and that do not exist."""
    missing = []
    for span in SPAN.findall(text):
        if span in TOPICS or span.startswith("seldinger/v"):
            continue
        if re.fullmatch(r"[\w.]+/[\w./*-]+", span) and span.split("/")[0] in ROOMS:
            if not list(ROOT.glob(span.rstrip("/"))):
                missing.append(span)
        elif re.fullmatch(r"\w+\.(py|c|h|js)", span) and span not in NAMES | WRITTEN_BY_A_USER:
            missing.append(span)
    return missing


def named(path: Path) -> str:
    """Name of a document in the output of pytest."""
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_local_links_resolve(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    broken = []
    for link in LINK.findall(text):
        if re.match(r"https?:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (document.parent / path).resolve() if path else document
        if not target.exists():
            broken.append(link)
        elif anchor and anchor not in {anchor_of(h) for h in re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE)}:
            broken.append(link)
    assert not broken


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_named_files_exist(document: Path) -> None:
    assert not missing_files(document.read_text(encoding="utf-8"))


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_commands_and_options_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    faults = {command: faults_of(command) for command in commands_of(text)}
    assert not {command: found for command, found in faults.items() if found}


def test_every_document_is_reached_from_the_readme() -> None:
    reached, waiting = set(), [ROOT / "README.md"]
    while waiting:
        document = waiting.pop()
        if document in reached or not document.exists() or document.suffix != ".md":
            continue
        reached.add(document)
        links = [link.partition("#")[0] for link in LINK.findall(document.read_text(encoding="utf-8"))]
        waiting += [(document.parent / link).resolve() for link in links if link and "://" not in link]
    assert set(DOCUMENTS) - reached == set()


def test_checks_find_planted_faults() -> None:
    text = (
        "Run `seldinger sovle x.json`.\n\n    seldinger demo --bord avr    # typo\n    make tset\n\n`pytest tests/none.py`"
    )
    found = [fault for command in commands_of(text) for fault in faults_of(command)]
    assert found == ["no command sovle", "demo has no option --bord", "no target tset", "no file tests/none.py"]
    assert missing_files("see `host/nowhere.py` and `nobody_wrote_this.py`") == ["host/nowhere.py", "nobody_wrote_this.py"]
