"""Several workers on one server: batches where the server has them, and each worker gets the answer to its own."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from roboxim_core.policies import EpisodeStart
from roboxim_policies.wires import find_wire

pytest.importorskip("vla_eval")

from vla_eval import api
from vla_eval.model_servers.predict import PredictModelServer

WORKERS = 3


class Batching(PredictModelServer):
    """A genuine model server of vla-eval with batches; its first batch waits until all others have asked."""

    def __init__(self):
        super().__init__(max_batch_size=WORKERS, max_wait_time=1.0)
        self.batches, self.received, self.all_asked = [], 0, threading.Event()

    async def on_observation(self, obs, ctx):
        self.received += 1
        if self.received == WORKERS:
            self.all_asked.set()
        await super().on_observation(obs, ctx)

    def predict_batch(self, obs_batch, ctx_batch):
        assert self.all_asked.wait(60)
        self.batches.append(len(obs_batch))
        return [{"actions": np.full(7, obs["images"]["image"].mean(), np.float32)} for obs in obs_batch]


def test_workers_of_a_vla_eval_server_are_one_batch_and_get_their_own_answers():
    server = Batching()

    def worker(number):
        wire = find_wire("vla_eval")(served.url, timeout_s=60.0)
        try:
            wire.reset(EpisodeStart(episode_id=f"e{number}", instruction="pick", seed=number))
            request = {"image": np.full((8, 8, 3), number, np.uint8), "prompt": "pick"}
            return [float(wire.ask(request)["actions"][0, 0]) for _ in range(4)]
        finally:
            wire.close()

    with api.serve_background(server) as served, ThreadPoolExecutor(WORKERS) as pool:
        answers = list(pool.map(worker, range(WORKERS)))
    assert answers == [[float(number)] * 4 for number in range(WORKERS)]
    assert sum(server.batches) == WORKERS * 4
    assert max(server.batches) > 1, "no requests were computed together"
