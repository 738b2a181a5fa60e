"""`roboxim export` offers every registered format, with options built from its configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import click
import pytest
from click.testing import CliRunner

from roboxim_cli.commands.stages.export import command
from roboxim_cli.field_options import field_options
from roboxim_core.errors import ConfigError
from roboxim_recorder.export import EXPORTERS, Selection


@dataclass(frozen=True, kw_only=True)
class ToyConfig(Selection):
    """Configuration of the toy format."""

    title: str = "toy"
    """Title of the ``toy``."""
    codec: Literal["h264", "av1"] = "h264"
    """Video codec."""
    masks: bool = False
    """Whether masks are exported."""


class ToyExporter:
    """Export toys."""

    config = ToyConfig


def test_a_registered_format_is_a_command_with_its_own_options(monkeypatch, tmp_path):
    monkeypatch.setitem(EXPORTERS._items, "toy", ToyExporter)
    runner = CliRunner()
    listed = runner.invoke(command, ["--help"]).output
    assert "toy" in listed
    assert "Export toys." in listed
    assert "rlds" in listed
    text = " ".join(runner.invoke(command, ["toy", "--help"]).output.split())
    for words in ("--title", "Title of the toy.", "[h264|av1]", "--masks / --no-masks", "--skip-missing", "--camera"):
        assert words in text, words
    refused = runner.invoke(command, ["toy", str(tmp_path), str(tmp_path), "--codec", "vp9"])
    assert refused.exit_code == 2
    assert "vp9" in refused.output


def test_options_of_rlds_are_those_of_its_configuration():
    options = {option.name: option for option in field_options(EXPORTERS["rlds"]().config, leave_out=vars(Selection()))}
    assert sorted(options) == ["encoding", "name", "shard_mib", "version"]
    assert isinstance(options["encoding"].type, click.Choice)
    assert "lossless" in options["encoding"].help


def test_a_field_that_has_no_option_is_named():
    @dataclass(frozen=True)
    class Strange:
        many: tuple[int, ...] = ()

    with pytest.raises(ConfigError, match="field 'many'"):
        field_options(Strange)
