"""What tells a policy from another of the same name: the contents of the files that it is made of.

A result belongs to those contents, not to a name: whoever edits a policy or trains a checkpoint again has another one.
What ships with RoboXim counts as its version does and has no files here.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from roboxim_core.policies import Policy
from roboxim_policies.bc.checkpoint_file import checkpoint_file

BLOCK = 1 << 20
INSTALLED = {"site-packages", "dist-packages"}


def policy_files(
    spec: str, make: Callable[..., Policy], options: Mapping[str, Any], *, exclude: Path | None = None
) -> dict[str, str]:
    """Return what a policy is made of.

    These are the Python file of its class, the files beside it (or in the working directory) that it imports, directly
    or through one another, and every file or folder that an option names, e.g. a checkpoint. What a policy opens under
    a path of its own is not known here.

    Args:
        spec: As `load_policy` takes it.
        make: What `find_policy` gives for it.
        options: Keyword arguments of its class.
        exclude: A folder that does not count, e.g. the one that results go to.

    Returns:
        File as a user would name it to its content's hash, 32 hexadecimal digits; a folder has one hash.

    Raises:
        OSError: When a file cannot be read.
    """
    found = {}
    for path in _sources(spec, make):
        found[_shown(path)] = _hash_file(path)
    for value in options.values():
        if not isinstance(value, str | Path) or not str(value):
            continue
        path = checkpoint_file(Path(value)) if spec == "bc" else Path(value)
        if path.is_file():
            found[_shown(path)] = _hash_file(path)
        elif path.is_dir():
            found[_shown(path)] = _hash_folder(path, exclude)
    return found


def _sources(spec: str, make: Callable[..., Policy]) -> list[Path]:
    """Return the policy's own Python files: that of its class, and what this imports of files beside it."""
    where = spec.rpartition(":")[0] or make.__module__
    if where.partition(".")[0] == "roboxim_policies":
        return []
    first = Path(where if where.endswith(".py") else sys.modules[where].__file__ or inspect.getfile(make)).resolve()
    root = first.parent
    while (root / "__init__.py").is_file():  # absolute imports start beside the outermost package
        root = root.parent
    installed = bool(INSTALLED & set(root.parts))
    roots = [root] if installed else [root, Path.cwd()]
    only = first.relative_to(root).parts[0].removesuffix(".py") if installed else ""
    found: set[Path] = set()
    queue = [first]
    while queue:
        file = queue.pop()
        if file not in found:
            found.add(file)
            queue += _imported(file, roots, only)
    return sorted(found)


def _imported(file: Path, roots: list[Path], only: str) -> Iterator[Path]:
    """Find the files that a file imports, absolutely from the roots (and only of one package) or relatively."""
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):
        return
    for node in ast.walk(tree):
        names: list[str] = []
        starts = roots
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [".".join(filter(None, (node.module, alias.name))) for alias in node.names]
            starts = [file.parents[node.level - 1]] if node.level else roots
        for name in names:
            if starts is not roots or not only or name.partition(".")[0] == only:
                yield from _files_of(name.split("."), starts)


def _files_of(parts: list[str], roots: list[Path]) -> Iterator[Path]:
    """Find a module's file, or that of the module that has it, and the ``__init__.py`` of the packages it is in."""
    for root in roots:
        for length in range(1, len(parts) + 1):
            place = root.joinpath(*parts[:length])
            for path in (place / "__init__.py", place.with_suffix(".py")):
                if path.is_file():
                    yield path.resolve()


def _shown(path: Path) -> str:
    """Name a file as seen from the working directory."""
    path = path.resolve()
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


def _hash_file(path: Path) -> str:
    content = hashlib.blake2b(digest_size=16)
    with path.open("rb") as file:
        while block := file.read(BLOCK):
            content.update(block)
    return content.hexdigest()


def _hash_folder(path: Path, exclude: Path | None) -> str:
    """Hash the names and contents of the files under a folder, hidden ones and compiled Python left out."""
    apart = None if exclude is None else exclude.resolve()
    content = hashlib.blake2b(digest_size=16)
    for file in sorted(path.resolve().rglob("*")):
        parts = file.relative_to(path.resolve()).parts
        hidden = any(part.startswith(".") or part == "__pycache__" for part in parts)
        if hidden or not file.is_file() or (apart is not None and file.is_relative_to(apart)):
            continue
        content.update(f"{'/'.join(parts)}\0{file.stat().st_size}\0{_hash_file(file)}\n".encode())
    return content.hexdigest()
