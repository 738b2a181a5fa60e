"""Fixtures for tests that involve several packages."""

import pytest

from roboxim_bringup.testing import graph, graph_parameters  # noqa: F401


@pytest.fixture(scope="session")
def expert_bag(tmp_path_factory):
    """Return a function that records a successful episode of the expert, and returns its bag, result and ticks."""
    from roboxim_bringup.core_graph import CoreGraph
    from roboxim_bringup.task_choice import task_text
    from roboxim_core.episode import EpisodeRunner, RunConfig
    from roboxim_recorder.bag import BagReader

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
