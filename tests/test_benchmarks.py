"""Benchmarks and scripts import only what exists: no other test runs them."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

ROOT = Path(__file__).parents[1]
FILES = sorted([*ROOT.glob("benchmarks/**/*.py"), *ROOT.glob("scripts/**/*.py")])


def missing(file: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(file.read_text())):
        if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("roboxim"):
            continue
        for name in node.names:
            if not hasattr(importlib.import_module(node.module), name.name):
                try:
                    importlib.import_module(f"{node.module}.{name.name}")
                except ModuleNotFoundError:
                    found.append(f"{file.relative_to(ROOT)}: {node.module} has no {name.name}")
    return found


@pytest.mark.thorough
def test_benchmarks_and_scripts_import_what_exists():
    assert FILES
    assert not [problem for file in FILES for problem in missing(file)]
