"""The identity of a policy: hashes of the files that it consists of.

A result belongs to the contents of these files, not to a name: editing a policy or retraining a checkpoint makes
another policy. For shipped policies the version of RoboXim is the identity, so they have no files here.
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
from roboxim_policies.learning.checkpoint_file import checkpoint_file
from roboxim_policies.learning.families import FAMILIES

BLOCK = 1 << 20
INSTALLED = {"site-packages", "dist-packages"}


def policy_files(
    spec: str, make: Callable[..., Policy], options: Mapping[str, Any], *, exclude: Path | None = None
) -> dict[str, str]:
    """Return the files and folders that a policy consists of, with hashes.

    These are the Python file of its class, the files beside it (or in the working directory) that it imports, directly
    or indirectly, and every file or folder that an option names, e.g. a checkpoint. Files that a policy opens under
    hard-coded paths are not detected.

    Args:
        spec: See `load_policy`.
        make: Result of `find_policy` for the spec.
        options: Keyword arguments of the class.
        exclude: A folder to ignore, e.g. the folder of the results.

    Returns:
        Path to the content's hash, 32 hexadecimal digits; a folder has one hash. A path is relative to the policy's
        folder (for its modules in the working directory, to that); of other files, such as a checkpoint, it is folder
        and name. So the same policy has the same paths wherever a command runs.

    Raises:
        OSError: When a file cannot be read.
    """
    sources, roots = _sources(spec, make)
    found = {_shown(path, roots): _hash_file(path) for path in sources}
    for value in options.values():
        if not isinstance(value, str | Path) or not str(value):
            continue
        path, near = Path(value), roots[:1]
        if spec in FAMILIES and checkpoint_file(path).is_file():
            path = checkpoint_file(path)
        if path.is_file() or path.is_dir():
            content = _hash_file(path) if path.is_file() else _hash_folder(path, exclude)
            name = _shown(path, near)
            found[name if found.get(name, content) == content else str(path.resolve())] = content
    return found


def location_free(spec: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return a policy's ``spec`` and ``options`` with a file's name instead of its path: its hash says which it is.

    Args:
        spec: See `load_policy`.
        options: Keyword arguments of the class; of ``reworded``, its ``policy`` is a specification, too.
    """
    inner = options.get("policy")
    if spec == "reworded" and isinstance(inner, str):
        options = {**options, "policy": location_free(inner, {})["spec"]}
    where, _, name = spec.rpartition(":")
    return {"spec": f"{Path(where).name}:{name}" if where.endswith(".py") else spec, "options": dict(options)}


def _sources(spec: str, make: Callable[..., Policy]) -> tuple[list[Path], list[Path]]:
    """Return the policy's own Python files, that of its class and those that it imports, and the roots of imports."""
    where = spec.rpartition(":")[0] or make.__module__
    if where.partition(".")[0] == "roboxim_policies":
        return [], []
    first = Path(where if where.endswith(".py") else sys.modules[where].__file__ or inspect.getfile(make)).resolve()
    root = first.parent
    while (root / "__init__.py").is_file():  # absolute imports start from the folder of the outermost package
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
    return sorted(found), roots


def _imported(file: Path, roots: list[Path], only: str) -> Iterator[Path]:
    """Find the files that a file imports, relatively or absolutely from the roots (``only``: just this package)."""
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
    """Find the file of a module, or of the module that defines the name, and the ``__init__.py`` of its packages."""
    for root in roots:
        for length in range(1, len(parts) + 1):
            place = root.joinpath(*parts[:length])
            for path in (place / "__init__.py", place.with_suffix(".py")):
                if path.is_file():
                    yield path.resolve()


def _shown(path: Path, roots: list[Path]) -> str:
    """Return a path relative to the first of the folders that it is in, else its folder and name."""
    path = path.resolve()
    inside = next((root for root in roots if path.is_relative_to(root)), path.parent.parent)
    return path.relative_to(inside).as_posix()


def _hash_file(path: Path) -> str:
    content = hashlib.blake2b(digest_size=16)
    with path.open("rb") as file:
        while block := file.read(BLOCK):
            content.update(block)
    return content.hexdigest()


def _hash_folder(path: Path, exclude: Path | None) -> str:
    """Hash the names and contents of the files in a folder, except hidden files and compiled Python."""
    apart = None if exclude is None else exclude.resolve()
    content = hashlib.blake2b(digest_size=16)
    for file in sorted(path.resolve().rglob("*")):
        parts = file.relative_to(path.resolve()).parts
        hidden = any(part.startswith(".") or part == "__pycache__" for part in parts)
        if hidden or not file.is_file() or (apart is not None and file.is_relative_to(apart)):
            continue
        content.update(f"{'/'.join(parts)}\0{file.stat().st_size}\0{_hash_file(file)}\n".encode())
    return content.hexdigest()
