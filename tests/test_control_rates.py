"""A task sets its control rate, and the expert acts at that rate."""

import pytest

pytest.importorskip("rclpy")

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_recorder.bag import BagReader
from roboxim_runs.episodes.task_choice import task_text
from roboxim_tasks.config import parse_task_config


def at_rate(rate_hz: float) -> str:
    """Return a task with its own rate and the skill's default step limit."""
    text = task_text("pick_cube")
    assert "rate_hz: 10" in text
    assert "max_steps: 100" in text
    return text.replace("rate_hz: 10", f"rate_hz: {rate_hz:g}").replace("max_steps: 100", "max_steps: 0")


@pytest.mark.parametrize(
    "rate_hz", [5.0, 20.0, pytest.param(10.0, marks=pytest.mark.slow), pytest.param(15.0, marks=pytest.mark.slow)]
)
@pytest.mark.thorough
def test_a_demonstration_at_the_tasks_rate_succeeds(rate_hz, tmp_path):
    config = RunConfig(
        run_seed=1, purpose="demo", task_config=at_rate(rate_hz), image_width=32, image_height=32,
        cameras=("workspace",), output_dir=str(tmp_path),
    )  # fmt: skip
    with CoreGraph(tmp_path) as graph:
        runner = EpisodeRunner(graph.ports, config)
        assert runner.description.semantics.rate_hz == 0.0
        result = runner.run_index(0)
    assert result.outcome == "success", result.message
    assert result.clipped == 0
    bag = BagReader(tmp_path / result.bag)
    assert bag.info.semantics.rate_hz == bag.info.scene.control_rate_hz == rate_hz
    ticks = list(bag.ticks(cameras=[]))
    assert ticks[-1].state.stamp_ns == round((len(ticks) - 1) * 1e9 / rate_hz)
    assert 3.0 < result.steps / rate_hz < 9.0, "the expert takes its time in seconds, not in ticks"


def test_a_skills_limit_is_a_time():
    limits = [parse_task_config(at_rate(rate)).max_steps for rate in (5.0, 10.0, 15.0, 20.0)]
    assert limits == [50, 100, 150, 200]
