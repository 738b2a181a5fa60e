"""Options are the same in every command: given once, with one name, for inputs and outputs alike."""

from __future__ import annotations

import inspect
from collections.abc import Iterator

import click
import pytest
from click.testing import CliRunner

from roboxim_cli import strict
from roboxim_cli.main import group
from roboxim_cli.options import SHARED
from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_runs.datasets.export import TRAINERS, trainer_options
from roboxim_runs.episodes.generation import GenerationConfig
from roboxim_runs.episodes.task_choice import mix_of, shares_text, task_text

OTHER_WORDS = {
    "--resolution": "--size", "--count": "--episodes", "--limit": "--episodes", "--number": "--episodes",
    "--output": "--out", "--target": "--out", "--html": "--out", "--file": "--out", "--sheet": "--out",
    "--cameras": "--camera", "--lights": "--light", "--textures": "--texture", "--skills": "--skill",
}  # fmt: skip
"""Words that a command might use for a shared option, to that option."""
ROS2 = ("topic", "service", "action", "param", "node", "interface")
"""Groups that are spelled as in ros2."""


def commands(command: click.Command = group, path: tuple[str, ...] = ()) -> Iterator[tuple[str, click.Command]]:
    """Yield every command with its words."""
    yield " ".join(path), command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found is not None
            yield from commands(found, (*path, name))


EVERY = dict(commands())


def test_every_command_refuses_an_option_given_twice():
    assert len(EVERY) > 90
    for name, command in EVERY.items():
        assert isinstance(command, strict.Strict), f"'{name}' is not made by roboxim_cli.strict"


@pytest.mark.parametrize("name", EVERY)
def test_a_command_takes_what_its_options_give(name):
    """An option whose parameter has another name ends the command with a TypeError."""
    of_decorators = {"domain", "run_id"}  # which make a peer of them
    taken = inspect.signature(EVERY[name].callback).parameters
    given = {parameter.name for parameter in EVERY[name].params if parameter.expose_value}
    assert given - of_decorators <= set(taken) or any(part.kind is part.VAR_KEYWORD for part in taken.values())


def test_an_option_given_twice_is_refused_by_name():
    for words in (
        ("generate", "--task", "stack", "--task", "pick_cube"),
        ("tasks", "sample", "--seed", "1", "--seed=2"),
        ("interface", "list", "-m", "-s"),
    ):
        result = CliRunner().invoke(group, words)
        assert result.exit_code == 2, words
        assert "given twice" in result.output
        assert any(word.partition("=")[0] in result.output for word in words if word.startswith("-"))
    twice = CliRunner().invoke(group, ["tasks", "sample", "--object", "cube", "--object", "target=cube", "--help"])
    assert twice.exit_code == 0, twice.output


@pytest.mark.parametrize("name", [name for name in EVERY if name.partition(" ")[0] not in ROS2])
def test_shared_options_have_one_name_and_one_type(name):
    for param in EVERY[name].params:
        if not isinstance(param, click.Option):
            continue
        for word in param.opts:
            assert word not in OTHER_WORDS, f"roboxim {name}: {word} is {OTHER_WORDS[word]} everywhere else"
            shared = SHARED.get(word.removeprefix("--"))
            if shared is None or shared.get("is_flag"):  # exports name the cameras whose depth they take
                continue
            kind = shared.get("type", click.STRING)
            assert type(param.type) is type(kind), f"roboxim {name} {word}: {param.type}"
            assert param.multiple == bool(shared.get("multiple")), f"roboxim {name} {word}"


def test_outputs_are_options():
    for name, command in EVERY.items():
        arguments = [param.name for param in command.params if isinstance(param, click.Argument)]
        assert not {"out", "target", "output"} & set(arguments), f"roboxim {name} has its output among the arguments"


def test_several_skills_share_the_episodes():
    words = ["tasks", "sample", "--episodes", "4"]
    lists = [["--skill", "pick_up,push_button"], ["--skill", "pick_up", "--skill", "push_button"]]
    first, second = (CliRunner().invoke(group, [*words, *given]).stdout for given in lists)
    assert first == second
    assert first.count("task: push_button") == 2
    with pytest.raises(ConfigError, match="unknown skill 'pik_up'"):
        task_text(skill="push_button,pik_up")


def test_a_mix_has_its_own_number_of_episodes_and_tells_its_shares(tmp_path):
    file = tmp_path / "mix.yaml"
    file.write_text("cells: [{tasks: [pick_up, stack, push_button], episodes: 2}]\n")
    told = []
    config = GenerationConfig(task=str(file), out=tmp_path / "out")
    assert config.sized(config.task_text(), told.append).episodes == 6
    assert "6 episodes: 2 of each of 3 cells" in told[0].text
    assert GenerationConfig().sized(task_text(), told.append).episodes == 50
    mix = mix_of(file.read_text())
    text = shares_text(mix, 20)
    assert "7 of pick_up" in text
    assert "a multiple of 3 gives every cell its share" in text


def test_an_export_says_which_trainer_reads_it():
    assert trainer_options("openpi", "lerobot", {}) == {"version": "2.1", "columns": "openpi"}
    with pytest.raises(ConfigError, match="octo reads rlds: roboxim export rlds"):
        trainer_options("octo", "lerobot", {})
    with pytest.raises(ConfigError, match="openpi needs --version 2.1, got --version 3.0"):
        trainer_options("openpi", "lerobot", {"version": "3.0"})
    assert set(TRAINERS) >= {"act", "openpi", "groot", "octo"}


def test_the_library_is_the_one_that_the_options_name():
    with pytest.raises(ConfigError, match="unknown object 'cubee'"):
        CliRunner().invoke(group, ["generate", "--object", "cubee"], catch_exceptions=False, standalone_mode=False)
    assert "cube" in ModelLibrary().object_ids


def test_options_of_robot_new_replace_the_values_of_a_recipe(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(
        "roboxim_runs.robots.derivation.derive", lambda recipe, *_, **__: made.append(recipe) or tmp_path
    )
    recipe = tmp_path / "mine.yaml"
    recipe.write_text("name: mine\nurdf: arm.urdf\nacceleration: [5]\nmount_xyz: [0, 0, 0.1]\n")
    words = ["robot", "new", str(recipe), "--name", "other", "--home", "0,1", "--cover", "--gripper", "franka_hand"]
    CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False)
    assert (made[0].name, made[0].home, made[0].cover) == ("other", (0.0, 1.0), True)
    assert (made[0].acceleration, made[0].mount_xyz) == ((5.0,), (0.0, 0.0, 0.1))
