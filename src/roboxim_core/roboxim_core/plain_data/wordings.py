"""Instructions in other words: sets of templates in ``config/wordings``, split into trained and held-out ones.

``SKILL.yaml`` has the wording that a task has by default (``first``) and sets of others: ``trained``, ``held_out``, and
other languages. ``words_SET.yaml`` translates names for a set of another language. A user's own files of the same names
replace them (``ROBOXIM_CONFIG_PATH``).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from string import Formatter
from typing import Any

from roboxim_core.config import load_yaml, named_config, place
from roboxim_core.config_folders import config_names
from roboxim_core.errors import ConfigError, one_of

KIND = "wordings"
FIRST = "first"
SLOTS = "slots"
"""Key of the words that may fill a slot, where an object's name beside it does not tell where it ends."""
WORDS = "words_"
File = tuple[Path, int, int]
"""A file, its time [ns] and its size [bytes], so that a changed one is read again."""


def wordings_of(skill: str, name: str) -> tuple[str, ...]:
    """Return a skill's templates of a set, with roles and parameters in braces.

    Args:
        skill: The skill.
        name: The set, e.g. ``held_out``.

    Raises:
        ConfigError: When the skill has no wordings, or no such set, or the set is of another language.
    """
    sets = _sets()
    if skill not in sets:
        raise ConfigError(f"there are no wordings of '{skill}' in config/{KIND}; {one_of(sets, skill)}")
    if name not in sets[skill] or name == FIRST:
        known = [each for each in sets[skill] if each != FIRST]
        raise ConfigError(f"the wordings of '{skill}' have no set '{name}'; {one_of(known, name)}")
    if _names(name):
        raise ConfigError(
            f"the wordings '{name}' are of another language, which the checks of tasks do not read: give them "
            f"to a policy (--policy reworded --option wordings={name})"
        )
    return sets[skill][name]


def english_wordings(skill: str) -> tuple[str, ...]:
    """Return a skill's templates of all sets in whose templates names stand as they are; empty: there are none."""
    sets = _sets_in(_file(skill)) if skill in config_names(KIND) else {}
    return tuple(template for name, templates in sets.items() if not _names(name) for template in templates)


def set_names() -> tuple[str, ...]:
    """Return the names of all sets."""
    return tuple(sorted({name for sets in _sets().values() for name in sets} - {FIRST}))


def require_set(name: str) -> None:
    """Check that some skill has a set.

    Raises:
        ConfigError: When none has.
    """
    if name not in set_names():
        raise ConfigError(f"no wordings have a set '{name}'; {one_of(set_names(), name)}")


def reworded(instruction: str, name: str) -> tuple[str, ...]:
    """Return an instruction in the words of a set.

    Args:
        instruction: An instruction in the first wording of a skill, e.g. ``Pick up the red cube``.
        name: The set.

    Returns:
        All wordings of the set; empty when the instruction follows no first wording, e.g. since it has several steps,
        or when its skill lacks the set.
    """
    for skill, sets in _sets().items():
        found = _pattern(_file(skill)).fullmatch(instruction.strip().rstrip("."))
        if found and name in sets:
            names = _names(name)
            filled = {key: names.get(word.lower(), word) for key, word in found.groupdict().items()}
            return tuple(template.format_map(filled) for template in sets[name])
    return ()


def names_in(template: str) -> list[str]:
    """Return the names in braces of a template, in their order.

    Raises:
        ConfigError: When a brace has no partner, or braces hold anything but a name.
    """
    try:
        parts = [part for part in Formatter().parse(template) if part[1] is not None]
    except ValueError as error:
        raise ConfigError(f"'{template}': {error}; expected names in braces, as in 'Pick up the {{target}}'") from None
    for _, name, spec, conversion in parts:
        if not name or not name.isidentifier() or spec or conversion:
            inside = f"{name}{f'!{conversion}' if conversion else ''}{f':{spec}' if spec else ''}"
            raise ConfigError(f"'{template}': expected a name in braces, as in {{target}}, got {{{inside}}}")
    return [name for _, name, _, _ in parts if name]


@lru_cache(maxsize=64)
def _pattern(file: File) -> re.Pattern[str]:
    """Return the pattern of the instructions in a skill's first wording."""
    content, pattern = _mapping(file), ""
    slots = content.get(SLOTS, {})
    for text, name, _, _ in Formatter().parse(content[FIRST]):
        pattern += re.escape(text)
        if name:
            words = "|".join(re.escape(str(word)) for word in slots.get(name, ())) or r"(?:(?!\b(?:then|also)\b)[^,])+?"
            pattern += f"(?P={name})" if f"(?P<{name}>" in pattern else f"(?P<{name}>{words})"
    return re.compile(pattern, re.IGNORECASE)


def _sets() -> dict[str, dict[str, tuple[str, ...]]]:
    """Return skill to set to templates."""
    return {skill: _sets_in(_file(skill)) for skill in config_names(KIND) if not skill.startswith(WORDS)}


@lru_cache(maxsize=64)
def _sets_in(file: File) -> dict[str, tuple[str, ...]]:
    """Return set to templates of a skill's file.

    Raises:
        ConfigError: When an entry is wrong; names the file, the entry and what was expected.
    """
    content = _mapping(file)

    def error(problem: object, *path: str | int) -> ConfigError:
        return ConfigError(f"{file[0]} is not valid: {place(content, path)}: {problem}")

    def names(*path: str | int) -> set[str]:
        template: Any = content
        for step in path:
            template = template[step]
        if not isinstance(template, str):
            raise error(f"expected a wording with names in braces, got {template!r}", *path)
        try:
            return set(names_in(template))
        except ConfigError as problem:
            raise error(problem, *path) from None

    if FIRST not in content:
        raise error("expected the skill's first wording, found no such key", FIRST)
    wanted = names(FIRST)
    slots = content.get(SLOTS, {})
    if not isinstance(slots, Mapping):
        raise error("expected a mapping of names in braces to lists of words", SLOTS)
    for name, words in slots.items():
        if name not in wanted:
            raise error(f"'{FIRST}' has no such name in braces; {one_of(sorted(wanted), str(name))}", SLOTS, name)
        if not isinstance(words, list) or not words or not all(map(_is_word, words)):
            raise error(f"expected a list of words, got {words!r}", SLOTS, name)
    found: dict[str, tuple[str, ...]] = {FIRST: (content[FIRST],)}
    for name, templates in content.items():
        if name in (FIRST, SLOTS):
            continue
        if not isinstance(templates, list) or not templates:
            raise error(f"expected a list of wordings, got {templates!r}", name)
        for number, template in enumerate(templates):
            if (used := names(name, number)) != wanted:
                said = ", ".join(f"{{{each}}}" for each in sorted(wanted))
                got = ", ".join(f"{{{each}}}" for each in sorted(used)) or "none"
                raise error(f"'{template}': expected {said} in braces, as in '{FIRST}', got {got}", name, number)
        found[str(name)] = tuple(templates)
    return found


def _is_word(value: Any) -> bool:
    return isinstance(value, str | int | float) and not isinstance(value, bool) and value != ""


def _names(name: str) -> dict[str, str]:
    file = f"{WORDS}{name}"
    return _names_in(_file(file)) if file in config_names(KIND) else {}


@lru_cache(maxsize=16)
def _names_in(file: File) -> dict[str, str]:
    content = _mapping(file)
    for key, value in content.items():
        if not _is_word(value):
            where = f"{file[0]} is not valid: {place(content, (key,))}"
            raise ConfigError(f"{where}: expected the words in place of a name, got {value!r}")
    return {str(key).lower(): str(value) for key, value in content.items()}


def _file(name: str) -> File:
    path = named_config(KIND, name)
    at = path.stat()
    return path, at.st_mtime_ns, at.st_size


def _mapping(file: File) -> Mapping[Any, Any]:
    content = load_yaml(file[0])
    if not isinstance(content, Mapping):
        raise ConfigError(f"{file[0]} is not valid: expected a mapping of keys, got {type(content).__name__}")
    return content
