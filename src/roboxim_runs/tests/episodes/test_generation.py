import pytest

from roboxim_core.config import to_plain
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import UnavailableError
from roboxim_runs.episodes.generation import GenerationConfig, generate
from roboxim_runs.executors import Done, Lost


class Executor:
    """An executor whose workers die at the second episode."""

    def run(self, work, jobs, **_):
        for job in jobs:
            made = EpisodeResult(episode_id=f"demo-0-{job.data:05d}-0", index=job.data, outcome="success")
            yield Lost(key=job.key, message="killed") if job.data == 1 else Done(key=job.key, value=to_plain(made))


def test_generation_whose_workers_died_is_no_success(tmp_path):
    config = GenerationConfig(out=tmp_path / "demos", episodes=3)
    with pytest.raises(
        UnavailableError, match=r"^2 demonstrations in .*, but 1 of 3 .*index 1: killed\. The same call"
    ):
        generate(config, executor=Executor())
