from __future__ import annotations

import pytest

from roboxim_bringup.parameters import merge, parse_assignments, parse_options, parse_policy, read_params_files
from roboxim_core.errors import ConfigError


def test_assignments_are_typed_and_belong_to_nodes():
    words = ["rate:=10", "sim:renderer:=tiny", "sim:sizes:=[1, 2]", "/w0/sim:x.y:=true", "text:='5'"]
    assert parse_assignments(words) == {
        "": {"rate": 10, "text": "5"},
        "sim": {"renderer": "tiny", "sizes": [1, 2]},
        "w0/sim": {"x.y": True},
    }
    assert parse_assignments(["rate:=10"], node="sim") == {"sim": {"rate": 10}}


@pytest.mark.parametrize("word", ["rate=10", "rate", ":=1", "a b:=1"])
def test_malformed_assignment_is_refused(word):
    with pytest.raises(ConfigError, match="name:=value"):
        parse_assignments([word])


def test_params_files_later_ones_win(tmp_path):
    one, two = tmp_path / "one.yaml", tmp_path / "two.yaml"
    one.write_text("/**: {ros__parameters: {rate: 5}}\n/w0/sim: {ros__parameters: {renderer: raster, a: {b: 1}}}")
    two.write_text("sim: {ros__parameters: {renderer: tiny}}")
    found = read_params_files([one, two], namespace="/w0")
    assert found == {"": {"rate": 5}, "sim": {"renderer": "tiny", "a.b": 1}}


@pytest.mark.parametrize("text", ["[1]", "sim: {renderer: tiny}", "", "sim: {ros__parameters: 5}"])
def test_malformed_params_file_is_refused(tmp_path, text):
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(ConfigError, match="bad.yaml"):
        read_params_files([tmp_path / "bad.yaml"])


def test_merge_by_node():
    assert merge({"sim": {"a": 1, "b": 1}}, {"sim": {"b": 2}, "": {"c": 3}}) == {"sim": {"a": 1, "b": 2}, "": {"c": 3}}


def test_options_and_policies():
    assert parse_options(["checkpoint=/tmp/a", "k=3"]) == {"checkpoint": "/tmp/a", "k": 3}
    with pytest.raises(ConfigError, match="key=value"):
        parse_options(["checkpoint"])
    with pytest.raises(ConfigError, match="'k' was given twice"):
        parse_options(["k=3", "k=4"])
    assert (parse_policy("a:B").namespace, parse_policy("a:B").spec) == ("policy", "a:B")
    assert (parse_policy("mine=a:B").namespace, parse_policy("mine=a:B").spec) == ("mine", "a:B")
