"""A Gymnasium environment whose episodes run in ``roboxim gymnasium serve``. Imports nothing of LeRobot."""

from __future__ import annotations

import contextlib
from typing import Any

import gymnasium
import msgpack
import numpy as np
from gymnasium.spaces import Box, Dict

STATE_BOUND = 10.0
"""Bound of ``agent_pos`` [m]."""


class RoboXimError(RuntimeError):
    """RoboXim refused a request; the message is its own."""


class RoboXimClient(gymnasium.Env):
    """An environment of RoboXim: the observations, rewards and seeds of ``roboxim:roboxim/PickCube-v0``."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - Gymnasium's own declaration

    def __init__(
        self,
        url: str = "ws://127.0.0.1:8765",
        task: str = "pick_cube",
        *,
        size: int = 256,
        control: str = "end_effector_delta",
        rate: float = 0.0,
        max_steps: int = 0,
        cameras: tuple[str, ...] = (),
        render_mode: str | None = "rgb_array",
        timeout_s: float = 300.0,
    ) -> None:
        """Connect, and make the environment.

        Args:
            url: Address of the server.
            task: Task of RoboXim's ``config/tasks``.
            size: Side of the pictures [px]; 0: as the task says.
            control: Control mode of the actions.
            rate: Control rate [Hz]; 0: the task's.
            max_steps: Actions per episode; 0: as the task says.
            cameras: Cameras to keep; empty: all of the task's.
            render_mode: ``rgb_array`` or None.
            timeout_s: Deadline of an answer [s].

        Raises:
            ConnectionError: When no server listens.
            RoboXimError: When RoboXim refuses an argument.
        """
        from websockets.sync.client import connect

        self.render_mode = render_mode
        self._timeout_s = timeout_s
        self._last: dict[str, Any] = {}
        self._open = contextlib.ExitStack()
        try:
            self._connection = self._open.enter_context(
                connect(url, compression=None, proxy=None, max_size=None, ping_interval=None, open_timeout=timeout_s)
            )
        except OSError as error:
            raise ConnectionError(
                f"no RoboXim at {url} ({error}); run 'roboxim gymnasium serve', or set --env.url"
            ) from None
        wanted = {"task": task, "size": size, "control": control, "rate": rate, "max_steps": max_steps}
        try:
            spec = self._asked({"make": wanted})["spec"]
            missing = sorted(set(cameras) - set(spec["pixels"]))
            if missing:
                raise RoboXimError(
                    f"task '{task}' has no camera {', '.join(missing)}, only {', '.join(spec['pixels'])}"
                )
        except BaseException:
            self.close()
            raise
        self._cameras = tuple(cameras or spec["pixels"])
        self.task = task
        self.task_description = ""
        """Instruction of the running episode."""
        self._max_episode_steps = int(spec["max_steps"])
        self.metadata = {**self.metadata, "render_fps": max(round(spec["rate_hz"]), 1)}  # whole, as video writers want
        pixels = {name: Box(0, 255, tuple(spec["pixels"][name]), np.uint8) for name in self._cameras}
        state = Box(-STATE_BOUND, STATE_BOUND, tuple(spec["agent_pos"]), np.float32)
        self.observation_space = Dict({"pixels": Dict(pixels), "agent_pos": state})
        self.action_space = Box(spec["action_low"], spec["action_high"], dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode: episode 0 of ``seed``, or the next one; ``options={"index": i}``: episode i."""
        super().reset(seed=seed)
        index = (options or {}).get("index")
        reply = self._asked({"reset": {"seed": None if seed is None else int(seed), "index": index}})
        self.task_description = reply["info"]["task_description"]
        return self._observation(reply), reply["info"]

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Execute an action."""
        reply = self._asked({"step": np.asarray(action, np.float32)})
        return self._observation(reply), reply["reward"], reply["terminated"], reply["truncated"], reply["info"]

    def render(self) -> np.ndarray | None:
        """Return the cameras' last pictures side by side; None without a render mode or an episode."""
        if self.render_mode is None or not self._last:
            return None
        return np.concatenate([self._last["pixels"][name] for name in self._cameras], axis=1)

    def close(self) -> None:
        """Close the connection, which frees the environment."""
        self._open.close()

    def _observation(self, reply: dict[str, Any]) -> dict[str, Any]:
        found = reply["observation"]
        self._last = {**found, "pixels": {name: found["pixels"][name] for name in self._cameras}}
        return self._last

    def _asked(self, request: dict[str, Any]) -> dict[str, Any]:
        self._connection.send(encode(request))
        reply = decode(self._connection.recv(timeout=self._timeout_s))
        if "error" in reply:
            raise RoboXimError(reply["error"])
        return reply


def encode(message: Any) -> bytes:
    """Encode a message; arrays as maps with bytes keys, as openpi does."""

    def default(part: Any) -> Any:
        if isinstance(part, np.ndarray) and part.dtype.kind in "biuf":
            return {b"__ndarray__": True, b"data": part.tobytes(), b"dtype": part.dtype.str, b"shape": part.shape}
        if isinstance(part, np.generic):
            return part.item()
        raise TypeError(f"a value of type {type(part).__name__} cannot be sent")

    return msgpack.packb(message, default=default)


def decode(data: bytes) -> Any:
    """Decode a message; no pickle."""

    def hook(part: dict) -> Any:
        if not part.get(b"__ndarray__"):
            return part
        dtype = np.dtype(part[b"dtype"])
        if dtype.kind not in "biuf":
            raise ValueError(f"arrays of type '{part[b'dtype']}' are refused")
        return np.frombuffer(part[b"data"], dtype).reshape(part[b"shape"]).copy()

    return msgpack.unpackb(data, object_hook=hook, raw=False, strict_map_key=False)
