"""Known answers over a real wire: a server that plays the expert's actions in a convention.

The expert solves an episode. Its actions are written in the convention's numbers, served over openpi's wire as float32,
as the models' servers send them, and executed by a remote policy in the same scene. The episode must succeed again:
then scale, axes, rotation form, polarity, delta base, chunking and rate of the convention mean what the export, the
wire and the episode loop take them to mean.
"""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.actions import ActionSemantics
from roboxim_core.conventions import Convention, from_actions
from roboxim_core.episode import EpisodeResult, EpisodeRunner, RunConfig
from roboxim_core.errors import EvaluationError
from roboxim_core.rotation.representations import Floats, encode, identity_rotation
from roboxim_policies.remote import RemotePolicy
from roboxim_policies.wires import openpi
from roboxim_policies.wires.arrays import MESSAGE_BYTES
from roboxim_runs.episodes.expert_episode import ExpertEpisode, expert_episode


class PlayingServer:
    """A server on openpi's wire that answers with given actions, one chunk after another."""

    def __init__(self, convention: Convention) -> None:
        """Prepare a server.

        Args:
            convention: The convention, whose keys and chunks the answers have.
        """
        self._convention = convention
        self._raw: Floats = np.zeros((1, convention.action.raw_size))
        self._tick = 0
        self.url = ""
        """Address, once it serves."""

    def play(self, raw: Floats) -> None:
        """Play actions from the next request on; after the last one, it is repeated.

        Args:
            raw: The convention's numbers, shape (n, D).
        """
        self._raw, self._tick = raw, 0

    @contextmanager
    def serving(self) -> Iterator[PlayingServer]:
        """Serve at a free port of this machine."""
        from websockets.sync.server import serve

        with serve(
            self._talk, "127.0.0.1", 0, compression=None, max_size=MESSAGE_BYTES, ping_interval=None, close_timeout=1.0
        ) as server:
            self.url = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
            thread = threading.Thread(target=server.serve_forever)
            thread.start()
            try:
                yield self
            finally:
                server.shutdown()
                thread.join()

    def _talk(self, connection: Any) -> None:
        connection.send(openpi.encode({}))
        for _ in connection:
            connection.send(openpi.encode(self._answer()))

    def _answer(self) -> Mapping[str, Any]:
        chunking = self._convention.chunking
        rows = [self._raw[min(self._tick + i, len(self._raw) - 1)] for i in range(chunking.horizon)]
        self._tick += chunking.execution.rows_per_request(len(rows))
        keys = self._convention.action.keys
        chunk = np.stack(rows).astype(np.float32)
        if len(keys) == 1:
            return {keys[0]: chunk}
        sizes = {chunk.shape[1]: [1] * len(keys), 3: [3, 3, 1], 2: [chunk.shape[1] - 1, 1]}[len(keys)]
        return dict(zip(keys, np.split(chunk, np.cumsum(sizes)[:-1], axis=1), strict=True))


def in_convention(convention: Convention, episode: ExpertEpisode) -> Floats:
    """Return the expert's actions in a convention's numbers, and one that holds still after them."""
    source = ActionSemantics(rate_hz=convention.rate_hz)
    raw = from_actions(convention, episode.actions, episode.track, source=source)
    if convention.semantics.control.is_joint_space or convention.semantics.control == "end_effector_absolute":
        return raw
    identity = encode(identity_rotation(), convention.semantics.rotation)
    still = np.concatenate([np.zeros(3), identity, episode.actions[-1, 6:]])
    return np.concatenate([raw, convention.action.encode(still[None], convention.frames)])


def play_expert(convention: Convention, index: int, *, task_config: str = "", seed: int = 0) -> EpisodeResult | None:
    """Let a server play the expert's actions of one episode; return the result of the remote policy.

    Args:
        convention: The convention.
        index: Index of the episode.
        task_config: Task as YAML text; empty: the default task.
        seed: Seed of the run.

    Returns:
        The result; None: the expert itself does not solve the episode.
    """
    try:
        episode = expert_episode(task_config, rate_hz=convention.rate_hz, seed=seed, index=index, attempts=1)
    except EvaluationError:
        return None
    return play_episode(convention, episode, index, task_config=task_config, seed=seed)


def play_episode(
    convention: Convention, episode: ExpertEpisode, index: int, *, task_config: str = "", seed: int = 0
) -> EpisodeResult:
    """Let a server play an episode of the expert, at the convention's rate; return the result of the remote policy.

    Pictures are left out, because they do not matter.

    Args:
        convention: The convention.
        episode: The expert's episode.
        index: Its index.
        task_config: Its task as YAML text; empty: the default task.
        seed: Seed of its run.
    """
    convention = replace(convention, images=())
    server = PlayingServer(convention)
    with server.serving(), tempfile.TemporaryDirectory() as folder:
        server.play(in_convention(convention, episode))
        wire = openpi.OpenPiWire(server.url)
        with (
            RemotePolicy(wire, convention, version="expert") as policy,
            CoreGraph(Path(folder), policy=policy) as graph,
        ):
            config = RunConfig(run_seed=seed, task_config=task_config, rate_hz=convention.rate_hz, output_dir="")
            return EpisodeRunner(graph.ports, config).run_index(index)
