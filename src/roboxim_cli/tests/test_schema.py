"""The reference of YAML files is that of the classes that read them, and every file of config/ keeps to it."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from roboxim_cli.main import group
from roboxim_cli.schema import KINDS, json_schema, page, schema_class
from roboxim_core.config_folders import config_dir, config_names
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.documents import parse_yaml

FILES = [
    (kind, path)
    for kind, (folder, _) in KINDS.items()
    for path in sorted((config_dir().parent / folder.partition(" ")[0]).glob("*.yaml"))
    if kind not in ("task", "mix") or ("cells" in parse_yaml(path.read_text())) == (kind == "mix")
]


def misfit(schema: dict[str, Any], value: Any, defs: dict[str, Any], where: str = "") -> str:
    """Return what a value has that a schema does not allow, in what `json_schema` uses of JSON Schema."""
    for part in schema.get("allOf", ()):
        if "if" not in part and (found := misfit(part, value, defs, where)):
            return found
    if "$ref" in schema:
        return misfit(defs[schema["$ref"].rpartition("/")[2]], value, defs, where)
    if "anyOf" in schema:
        found = [misfit(arm, value, defs, where) for arm in schema["anyOf"]]
        return "" if "" in found else found[0]
    if "enum" in schema:
        return "" if value in schema["enum"] else f"{where}: {value!r} is none of {schema['enum']}"
    types = {
        "object": dict, "array": list, "string": str, "boolean": bool, "integer": int, "number": (int, float),
        "null": type(None),
    }  # fmt: skip
    kinds = schema.get("type", list(types))
    if not any(isinstance(value, types[kind]) for kind in ([kinds] if isinstance(kinds, str) else kinds)):
        return f"{where}: expected {kinds}, got {value!r}"
    if isinstance(value, dict) and kinds == "object":
        for key in schema.get("required", ()):
            if key not in value:
                return f"{where}: lacks {key}"
        for key, item in value.items():
            inner = schema.get("properties", {}).get(key, schema.get("additionalProperties", {}))
            if inner is False:
                return f"{where}: unknown key {key}"
            if found := misfit(inner, item, defs, f"{where}.{key}"):
                return found
    if isinstance(value, list) and "items" in schema:
        return next((text for item in value if (text := misfit(schema["items"], item, defs, f"{where}[]"))), "")
    return ""


@cache
def schema_of(kind: str) -> dict[str, Any]:
    return json_schema(schema_class(kind))


@pytest.mark.parametrize(("kind", "path"), FILES, ids=lambda value: value if isinstance(value, str) else value.stem)
def test_every_file_keeps_to_its_schema(kind, path):
    schema = schema_of(kind)
    content = parse_yaml(path.read_text())
    if kind == "experiment":
        content.pop("scales", None)
    assert misfit(schema, content, schema["$defs"]) == ""


def test_a_wrong_key_and_a_wrong_value_do_not_keep_to_it():
    schema = json_schema(schema_class("task"))
    assert "unknown key intensty" in misfit(
        schema, {"skill": "stack", "reset": {"lights": {"intensty": 1}}}, schema["$defs"]
    )
    assert "expected number" in misfit(schema, {"skill": "stack", "rate_hz": "fast"}, schema["$defs"])


def test_the_page_of_the_documentation_is_current():
    written = (Path(__file__).resolve().parents[3] / "docs" / "reference" / "yaml.md").read_text()
    assert written == page(), "run: roboxim schema all --out docs/reference/yaml.md"
    assert {kind for kind, _ in FILES} == set(KINDS) - {"bc", "rt1s", "act", "given"}  # no file of config is one


def test_kinds_are_found_by_their_plural_and_suggested(tmp_path):
    for plural in ("tasks", "lights", "cameras", "suite", "benchmarks"):
        assert schema_class(plural)
    with pytest.raises(ConfigError, match="did you mean 'camera'"):
        schema_class("camra")
    file = tmp_path / "light.json"
    CliRunner().invoke(group, ["schema", "light", "--out", str(file)], catch_exceptions=False)
    assert json.loads(file.read_text())["$defs"]["Lighting"]["properties"]["ambient"]
    assert config_names("lights")
