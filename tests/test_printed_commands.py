"""Every command that code, templates, messages, help and documentation name exists, with its options."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import click
import pytest

from roboxim_cli.main import group

ROOT = Path(__file__).parents[1]
NAMED = re.compile(r"\broboxim((?: +[^\s`'\"<>|;,()]+)+)")
"""The program's name and the words behind it."""
PLACEHOLDER = "FILE"


def literals(source: str) -> Iterator[str]:
    """Yield the texts of a module; what an f-string fills in is a placeholder."""
    tree = ast.parse(source)
    inside = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else PLACEHOLDER for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inside:
            yield node.value


def texts() -> Iterator[tuple[str, str]]:
    """Yield each file's name and its texts."""
    for file in sorted(ROOT.glob("src/*/roboxim*/**/*.py")):
        source = file.read_text()
        for text in literals(source) if "roboxim " in source else ():
            if "roboxim " in text:
                yield str(file.relative_to(ROOT)), text
    for pattern in (
        "src/*/roboxim*/**/templates/*",
        "docs/**/*.md",
        "README.md",
        "src/*/README.md",
        "src/*/web/**/*.js",
    ):
        for file in sorted(ROOT.glob(pattern)):
            if file.is_file():
                yield str(file.relative_to(ROOT)), re.sub(r"\{\{.*?\}\}|\$\{.*?\}", PLACEHOLDER, file.read_text())


@cache
def known(command: click.Command, name: str) -> click.Command | None:
    return command.get_command(click.Context(command), name) if isinstance(command, click.Group) else None


def complaint(words: list[str]) -> str:
    """Return what is wrong with a command's subcommands and options; empty: nothing, or it is prose."""
    found, path = known(group, words[0]), words[:1]
    if found is None:
        return ""  # prose: "roboxim is"
    for word in words[1:]:
        option = re.match(r"(--?[a-z][a-z-]*)", word)
        if option:
            names = {name for parameter in found.params for name in (*parameter.opts, *parameter.secondary_opts)}
            if option[1] not in names | {"-h", "--help"}:
                return f"'{' '.join(path)}' has no option {option[1]}"
        elif isinstance(found, click.Group) and re.fullmatch(r"[a-z][a-z0-9_-]*", word):
            sub = known(found, word)
            if sub is None:
                return f"'{' '.join(path)}' has no command '{word}'"
            found, path = sub, [*path, word]
        elif isinstance(found, click.Group):
            return ""  # a word that the reader fills in, e.g. FORMAT
    return ""


def test_every_command_that_is_named_exists(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    wrong, checked = [], set()
    for file, text in texts():
        for line in text.replace("\\\n", " ").splitlines():
            for match in NAMED.finditer(line):
                words = [word.rstrip(".:") for word in match[1].split()]
                if known(group, words[0]) is not None:
                    checked.add((file, words[0]))
                if said := complaint(words):
                    wrong.append(f"{file}: roboxim {' '.join(words)}: {said}")
    assert not wrong, "\n".join(wrong)
    assert len(checked) > 150
    assert len({name for _, name in checked}) > 25


def test_what_does_not_exist_is_found() -> None:
    assert complaint(["up", "--headless"]) == "'up' has no option --headless"
    assert complaint(["bag", "mend", "FILE"]) == "'bag' has no command 'mend'"
    assert complaint(["bag", "info", "FILE"]) == ""
    assert complaint(["is", "a", "program"]) == ""
