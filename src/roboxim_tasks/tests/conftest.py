"""What the tests of this room share."""

import pytest

from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_tasks.config import load_task_config
from roboxim_tasks.sampling.episodes import EpisodeGenerator


@pytest.fixture(scope="session")
def library():
    return ModelLibrary()


@pytest.fixture(scope="session")
def generator(library):
    return EpisodeGenerator(library)


@pytest.fixture(scope="session")
def draw(generator):
    """Draw episode ``index`` of a named task or a configuration."""

    def episode(index, config="pick_cube_distractors", **seed):
        config = load_task_config(config) if isinstance(config, str) else config
        return generator.draw(SeedPath(**{"run_seed": 3, "purpose": "test", "index": index, **seed}), config)

    return episode


@pytest.fixture(scope="session")
def seed_path():
    """The seed path of an index."""
    return lambda index, **seed: SeedPath(**{"run_seed": 3, "purpose": "test", "index": index, **seed})
