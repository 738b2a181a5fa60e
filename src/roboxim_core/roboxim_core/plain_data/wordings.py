"""Instructions in other words: sets of templates in ``config/wordings``, split into trained and held-out ones.

``SKILL.yaml`` has the wording that a task has by default (``first``) and sets of others: ``trained``, ``held_out``, and
other languages. ``words_SET.yaml`` translates names for a set of another language. A user's own files of the same names
replace them (``ROBOXIM_CONFIG_PATH``).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from string import Formatter
from typing import Any

from roboxim_core.config import load_yaml, named_config
from roboxim_core.config_folders import config_names
from roboxim_core.errors import ConfigError, one_of

KIND = "wordings"
FIRST = "first"
SLOTS = "slots"
"""Key of the words that may fill a slot, where an object's name beside it does not tell where it ends."""
WORDS = "words_"


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
    sets = _sets().get(skill, {})
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
        found = _pattern(skill, sets[FIRST][0]).fullmatch(instruction.strip().rstrip("."))
        if found and name in sets:
            names = _names(name)
            filled = {key: names.get(word.lower(), word) for key, word in found.groupdict().items()}
            return tuple(template.format_map(filled) for template in sets[name])
    return ()


@lru_cache(maxsize=64)
def _pattern(skill: str, template: str) -> re.Pattern[str]:
    slots = _mapping(skill).get(SLOTS, {})
    if not isinstance(slots, Mapping) or not all(isinstance(words, list) and words for words in slots.values()):
        raise ConfigError(f"config/{KIND}/{skill}.yaml: '{SLOTS}' must map names in braces to lists of words")
    parts = []
    for text, name, _, _ in Formatter().parse(template):
        words = "|".join(re.escape(str(word)) for word in slots.get(name, ())) or r"(?:(?!\bthen\b)[^,])+?"
        parts.append(re.escape(text) + (f"(?P<{name}>{words})" if name else ""))
    return re.compile("".join(parts), re.IGNORECASE)


@lru_cache(maxsize=1)
def _sets() -> dict[str, dict[str, tuple[str, ...]]]:
    """Return skill to set to templates."""
    found: dict[str, dict[str, tuple[str, ...]]] = {}
    for skill in config_names(KIND):
        if skill.startswith(WORDS):
            continue
        content = _mapping(skill)
        first = content.get(FIRST)
        if not isinstance(first, str):
            raise ConfigError(f"config/{KIND}/{skill}.yaml: '{FIRST}' must be the skill's first wording")
        wanted = _roles(first)
        found[skill] = {FIRST: (first,)}
        for name, templates in content.items():
            if name in (FIRST, SLOTS):
                continue
            good = isinstance(templates, list) and templates and all(isinstance(each, str) for each in templates)
            if not good or any(_roles(each) != wanted for each in templates):
                raise ConfigError(
                    f"config/{KIND}/{skill}.yaml: '{name}' must be a list of wordings with {', '.join(sorted(wanted))} "
                    "in braces"
                )
            found[skill][str(name)] = tuple(templates)
    return found


@lru_cache(maxsize=16)
def _names(name: str) -> dict[str, str]:
    if f"{WORDS}{name}" not in config_names(KIND):
        return {}
    return {str(key).lower(): str(value) for key, value in _mapping(f"{WORDS}{name}").items()}


def _mapping(file: str) -> Mapping[str, Any]:
    content = load_yaml(named_config(KIND, file))
    if not isinstance(content, Mapping):
        raise ConfigError(f"config/{KIND}/{file}.yaml must be a mapping")
    return content


def _roles(template: str) -> set[str]:
    return {name for _, name, _, _ in Formatter().parse(template) if name}


__all__ = ["english_wordings", "require_set", "reworded", "set_names", "wordings_of"]
