"""Untrusted text is read within bounds: it causes no traceback and does not fill the memory."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from roboxim_core import limits
from roboxim_core.config import from_json, line_of, load_yaml
from roboxim_core.errors import ConfigError, InvalidRequestError
from roboxim_core.plain_data.documents import parse_json, parse_yaml, read_text
from roboxim_core.specs import CameraSpec, EntitySpec, SceneSpec

BOMB = "\n".join(
    ["a0: &a0 [x, x, x, x, x, x, x, x, x]"] + [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 10)]
)


def test_aliases_are_counted_by_what_they_repeat():
    with pytest.raises(ConfigError, match=r"task line 7: more than 1000000 values"):
        parse_yaml(BOMB, source="task")
    data = parse_yaml("base: &base {size: [1, 2]}\nother: {<<: *base}\nagain: [*base, *base]")
    assert data["other"]["size"] == data["again"][1]["size"] == [1, 2]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[" * 3000, "line 1: more than 64 levels"),
        ("- " * 3000 + "x", "line 1: more than 64 levels"),
        ("{a: " * 3000, "line 1: more than 64 levels"),
        ("\n".join(" " * n + "a:" for n in range(70)), "line 6[0-9]: more than 64 levels"),
        ("a: &a [*a]", r"line 1: alias '\*a' is inside the value that it repeats"),
        ("a: *nothing", "line 1: not valid YAML"),
        ("a: 2024-99-99", "not valid YAML"),
        ("a: " + "9" * 5000, "not valid YAML"),
        ("a: b: c", "line 1: not valid YAML"),
        ("\0", "not valid YAML"),
        ("# " + "x" * limits.YAML_BYTES, "larger than"),
    ],
)
def test_bad_yaml_is_an_error_by_line(text, complaint):
    with pytest.raises(ConfigError, match=rf"^task:? ?{complaint}"):
        parse_yaml(text, source="task")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
def test_text_of_unicode_encodings_is_read(tmp_path, encoding):
    (tmp_path / "task.yaml").write_bytes("# Würfel\nskill: pick_up\n".encode(encoding))
    assert read_text(tmp_path / "task.yaml") == "# Würfel\nskill: pick_up\n"
    assert load_yaml(tmp_path / "task.yaml") == {"skill": "pick_up"}


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("skill: pick_up\n# Würfel\n".encode("latin-1"), "line 2: not UTF-8 text.*save the file as UTF-8"),
        ("skill".encode("utf-16")[:-1], "line 1: not UTF-16 text"),
    ],
)
def test_text_of_other_encodings_is_refused_in_a_sentence(tmp_path, content, complaint):
    (tmp_path / "task.yaml").write_bytes(content)
    with pytest.raises(ConfigError, match=complaint):
        load_yaml(tmp_path / "task.yaml")


def test_plain_scalars_have_the_meaning_of_yaml_1_2():
    text = "[017, 0o17, 0x1F, 1_000, 1e3, .5, -.INF, 1:30, yes, on, ~, '1', 08, 0.1_0, True, 1.2.3]"
    expected = [17, 15, 31, 1000, 1000.0, 0.5, float("-inf"), "1:30", "yes", "on", None, "1", 8, 0.1, True, "1.2.3"]
    data = parse_yaml(text)
    assert data == expected
    assert [type(value) for value in data] == [type(value) for value in expected]


def test_merged_keys_follow_the_own_ones_and_know_their_lines():
    data = parse_yaml("base: &base {x: 1, y: 2}\nother:\n  <<: *base\n  y: 3\nthird: {<<: [{x: 5}, *base]}")
    assert list(data["other"].items()) == [("y", 3), ("x", 1)]
    assert data["third"] == {"x": 5, "y": 2}
    assert [line_of(data["other"], key) for key in ("x", "y")] == ["line 1", "line 4"]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a: 1\nb: 2\na: 3", "line 3: not valid YAML: the key 'a' occurs twice"),
        ("x: 1\n[a]: 1", "line 2: not valid YAML: a key must be one value"),
        ("x: 1\na: !thing 1", "line 2: not valid YAML: could not determine a constructor"),
        ("a: 1\n---\nb: 2", "line 2: not valid YAML"),
    ],
)
def test_what_configurations_do_not_hold_is_refused_by_line(text, complaint):
    with pytest.raises(ConfigError, match=rf"^task {complaint}"):
        parse_yaml(text, source="task")


def test_nesting_through_aliases_is_counted():
    text = "a0: &a0 [x]\n" + "\n".join(f"a{n}: &a{n} [*a{n - 1}]" for n in range(1, 80))
    with pytest.raises(ConfigError, match="more than 64 levels"):
        parse_yaml(text)


def test_files_that_are_no_text_are_errors_by_line(tmp_path):
    file = tmp_path / "task.yaml"
    file.write_bytes(b"skill: pick_up\nname: \xff\xfe\n")
    with pytest.raises(ConfigError, match=r"task\.yaml line 2: not UTF-8 text"):
        load_yaml(file)
    with pytest.raises(ConfigError, match="cannot read"):
        load_yaml(tmp_path)
    with pytest.raises(ConfigError, match="cannot read"):
        load_yaml(tmp_path / ("x" * 300))


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, "[" * 70 + "]" * 70, "NaN", '{"a": -Infinity}', "9" * 5000, '"\\ud800"', "{", "", "nonsense"],
)
def test_bad_json_is_an_error(text):
    with pytest.raises(ConfigError, match=r"^results\.jsonl"):
        parse_json(text, source="results.jsonl")


def test_json_within_the_bounds_is_read():
    assert parse_json('{"a": [1, 2.5, "\\u00e4", null, true]}') == {"a": [1, 2.5, "ä", None, True]}
    with pytest.raises(ConfigError, match="finite|64 bits"):
        from_json('{"physics_rate_hz": 1e999}', SceneSpec)
    with pytest.raises(ConfigError, match="64 bits"):
        from_json('{"settle_steps": 99999999999999999999}', SceneSpec)


@pytest.mark.parametrize("name", ["", "robot", "table", "world", "tcp", "a/b", "a\nb", "x" * 300, "\ud800", "../x"])
def test_names_that_mean_something_else_are_refused_by_name(name):
    with pytest.raises(InvalidRequestError, match="entity name"):
        EntitySpec(name=name, model="cube")


@pytest.mark.parametrize("name", ["", "a/b", "x" * 300, "a\tb"])
def test_cameras_with_impossible_names_are_refused(name):
    with pytest.raises(InvalidRequestError, match="camera name"):
        CameraSpec(name=name)


@pytest.mark.parametrize(
    "change",
    [
        {"physics_rate_hz": 1e300}, {"control_rate_hz": 1e-9}, {"settle_steps": 10**9},
        {"physics_rate_hz": float("nan")},
        {"cameras": tuple(CameraSpec(name=f"c{i}") for i in range(17))},
        {"cameras": tuple(CameraSpec(name=f"c{i}", width=4096, height=4096) for i in range(2))},
        {"entities": tuple(EntitySpec(name=f"e{i}", model="cube") for i in range(201))},
    ],
)  # fmt: skip
def test_scenes_beyond_the_bounds_are_refused(change):
    with pytest.raises(InvalidRequestError):
        SceneSpec(**change)


def test_every_bound_says_why():
    source = Path(limits.__file__).read_text()
    for name, following in itertools.pairwise([*source.split("\n"), ""]):
        if ": Final" in name and not name.rstrip().endswith("{"):
            assert following.startswith('"""'), name
