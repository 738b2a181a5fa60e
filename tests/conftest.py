"""Fixtures for tests that involve several packages."""

import gc

import pytest

from roboxim_bringup.testing import graph, graph_parameters  # noqa: F401


def pytest_collection():
    """Collect no garbage while tests are collected: almost all that is made then stays."""
    gc.disable()


def pytest_collection_finish():
    """Exempt what exists after the collection of tests from garbage collection, and collect the rest less often."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


def pytest_unconfigure():
    """Let the interpreter free all of it at its end; nanobind reports what is left as leaks."""
    gc.unfreeze()


@pytest.fixture(scope="session")
def expert_bag(tmp_path_factory):
    """Return a function that records a successful episode of the expert, and returns its bag, result and ticks."""
    from roboxim_bringup.core_graph import CoreGraph
    from roboxim_core.episode import EpisodeRunner, RunConfig
    from roboxim_recorder.bag import BagReader
    from roboxim_runs.episodes.task_choice import task_text

    def record(*, seed, index=0, size):
        folder = tmp_path_factory.mktemp("expert")
        config = RunConfig(
            run_seed=seed, purpose="eval", task_config=task_text("pick_cube"), image_width=size, image_height=size,
            output_dir=str(folder),
        )  # fmt: skip
        with CoreGraph(folder) as cores:
            result = EpisodeRunner(cores.ports, config).run_index(index)
        assert result.outcome == "success"
        return folder / result.bag, result, list(BagReader(folder / result.bag).ticks())

    return record


@pytest.fixture(scope="session")
def small_bc(tmp_path_factory):
    """A `bc` checkpoint after four steps on random pictures of 32 x 32 px: it acts, but cannot do anything."""
    import numpy as np

    from roboxim_core.actions import ActionSemantics
    from roboxim_core.proprioception import Proprioception
    from roboxim_policies.bc.config import BCConfig
    from roboxim_policies.learning.data import Demonstration, assemble
    from roboxim_policies.learning.train import Trainer

    rng = np.random.default_rng(0)
    demonstrations = [
        Demonstration(
            images={name: rng.integers(0, 255, (8, 32, 32, 3), np.uint8) for name in ("workspace", "wrist")},
            proprio=np.stack([Proprioception(tcp_position=(0.5, 0.01 * i, 0.3)).vector() for i in range(8)]),
            actions=np.float32(rng.normal(size=(8, 7)) * 0.01 + np.array([0] * 6 + [0.5])),
            instruction="Pick up the red cube",
        )
        for _ in range(4)
    ]
    sizes = {"workspace": (32, 32), "wrist": (32, 32)}
    data = assemble(demonstrations, camera_sizes=sizes, semantics=ActionSemantics(), robot="panda")
    settings = BCConfig(
        steps=4, batch=4, warmup_steps=1, chunk=4, execute=2, channels=8, keypoints=8, hidden=32,
        image_sizes={"workspace": 32, "wrist": 32}, checkpoint_every=4,
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("bc")
    Trainer(data, settings, folder).run()
    return folder
