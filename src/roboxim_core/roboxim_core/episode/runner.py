"""The episode loop: `EpisodeRunner` runs episodes over the ports."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace

import numpy as np

from roboxim_core.actions import ActionArray, ActionSemantics, LateRows
from roboxim_core.config import to_json
from roboxim_core.episode.acting import Acting, TickAction, holding_action
from roboxim_core.episode.ports import ActorPort, Ports
from roboxim_core.episode.records import EpisodeInfo, EpisodeResult, EpisodeStep, RunConfig
from roboxim_core.episode.start import start_refusal
from roboxim_core.errors import ErrorCode, EvaluationError, InvalidRequestError, PolicyError, RoboximError, one_of
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policies import (
    DESCENT,
    FREE,
    RECOVERY,
    ActionChunk,
    EpisodeStart,
    Observation,
    ObservationWindow,
    PolicyDescription,
)
from roboxim_core.policy_guard import checked_answer
from roboxim_core.rates import ticks
from roboxim_core.recorded import recorded_parameters
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import CameraSpec, SceneSpec, TaskSpec

Request = EpisodeStart | ObservationWindow
"""Requests of an episode to its actor: to start, answered by None, and for actions."""
Play = Generator[Request, ActionChunk | None, EpisodeResult]
"""A running episode whose actions come from outside."""
LEFT_WORKSPACE = "left_workspace"
RECOVERED = "recovered"
"""Reason of an episode that succeeded after a second grasp, in a run that keeps first tries alone."""
SETTLE_S = 1.0
"""Default time for which the robot holds still between the end of an episode and the final verdict."""


def episode_id(seed: SeedPath) -> str:
    """Return the id of an episode: unique in a run, equal in repeated runs, usable as a file name."""
    return f"{seed.purpose}-{seed.run_seed}-{seed.index:05d}-{seed.attempt}"


def configure_scene(scene: SceneSpec, config: RunConfig, description: PolicyDescription) -> SceneSpec:
    """Apply a run's cameras, sizes and rate to a scene.

    A size that the policy states for a camera precedes the run's, since a model accepts no other.

    Raises:
        InvalidRequestError: When a requested camera is not in the scene.
    """
    wanted = {camera.name: camera for camera in description.cameras}
    names = config.cameras or tuple(camera.name for camera in scene.cameras)
    have = {camera.name: camera for camera in scene.cameras}
    for name in (*names, *wanted):
        if name not in have:
            raise InvalidRequestError(f"no camera '{name}'; {one_of(have, name)}", ErrorCode.UNKNOWN_CAMERA)
    names = tuple(dict.fromkeys((*names, *wanted)))

    def sized(camera: CameraSpec) -> CameraSpec:
        want = wanted.get(camera.name)
        width = (want.width if want else 0) or config.image_width or camera.width
        height = (want.height if want else 0) or config.image_height or camera.height
        return replace(
            camera.resized(width, height),
            depth=config.depth or camera.depth,
            segmentation=config.segmentation or camera.segmentation,
        )

    return replace(
        scene,
        cameras=tuple(sized(have[name]) for name in names),
        control_rate_hz=config.rate_hz or description.semantics.rate_hz or scene.control_rate_hz,
    )


def executed_semantics(scene: SceneSpec, description: PolicyDescription) -> ActionSemantics:
    """Return the meaning in which the simulator executes a policy's actions.

    Args:
        scene: The scene as `configure_scene` returns it.
        description: The policy's description.

    Raises:
        InvalidRequestError: When the policy states another rate than the scene has.
    """
    declared = description.semantics
    declared.require_compatible(
        replace(declared, rate_hz=scene.control_rate_hz), owner=f"policy '{description.name}'", other_owner="the run"
    )
    return declared.executed(scene.control_rate_hz)


def _require_consistent(description: PolicyDescription, config: RunConfig) -> None:
    """Refuse a configuration that does not fit a policy."""
    chunking = config.chunking(description.chunking)
    noisy = config.noise_translation_m > 0 or config.noise_rotation_rad > 0
    if noisy and description.semantics.control.is_joint_space:
        raise InvalidRequestError(
            f"policy '{description.name}' acts by '{description.semantics.control}', and noise is added to "
            "end-effector deltas only; set noise_translation_m and noise_rotation_rad to 0"
        )
    if chunking.late_rows == LateRows.DROP and config.latency_ticks >= description.horizon:
        raise InvalidRequestError(
            f"answers arrive {config.latency_ticks} ticks late, and policy '{description.name}' answers at most "
            f"{description.horizon} actions: late_rows 'drop' would leave none; use 'shift'"
        )


class _Window:
    """The last observations, padded by repeating the first."""

    def __init__(self, size: int) -> None:
        self._items: deque[Observation] = deque(maxlen=size)
        self._size = size

    def add(self, observation: Observation) -> None:
        self._items.append(observation)

    def request(self, info: EpisodeInfo, commanded_opening: float | None = None) -> ObservationWindow:
        missing = self._size - len(self._items)
        return ObservationWindow(
            instruction=info.task.instruction,
            observations=[self._items[0]] * missing + list(self._items),
            pad_mask=(False,) * missing + (True,) * len(self._items),
            episode_id=info.episode_id,
            seq=self._items[-1].seq,
            commanded_opening=commanded_opening,
        )


class EpisodeRunner:
    """Runs episodes over the ports; one instance serves a whole run."""

    def __init__(
        self,
        ports: Ports,
        config: RunConfig,
        *,
        versions: dict[str, str] | None = None,
        library: ModelLibrary | None = None,
        repeat: Sequence[Sequence[float]] = (),
    ) -> None:
        """Prepare a run: ask the actor for its description.

        Args:
            ports: The ports of the loop.
            config: Configuration of the run.
            versions: Package name to version, for the bags.
            library: Robots and objects, whose hashes are recorded in the bags; None: no hashes.
            repeat: Actions that every episode begins with, in the executed meaning, one per tick: of an episode from
                whose state the actor takes over. The simulator is deterministic, so they restore its state, contacts
                and the solver's memory included. The actor's conventions do not apply to them.

        Raises:
            RoboximError: When the actor does not describe itself.
            InvalidRequestError: When the configuration does not fit the policy, e.g. noise for joint actions.
        """
        self.ports = ports
        self.config = config
        self.versions = dict(versions or {})
        self._library = library
        self.repeat = repeat
        self.description = ports.actor.describe()
        _require_consistent(self.description, config)
        self.warm = False
        """Whether the policy has answered once; loading and compiling before that do not count as thinking time."""
        self.progress: tuple[str, int] = ("", 0)
        """Id and tick of the running episode, for progress displays."""

    def run_index(self, index: int, *, cancelled: Callable[[], bool] = lambda: False) -> EpisodeResult:
        """Run one index until an episode is kept or the attempts are used up.

        Args:
            index: Index in the run.
            cancelled: Called before every tick; True cancels the episode.

        Returns:
            The last attempt's result.

        Raises:
            RoboximError: On a fault of sim, judge or recorder, or on cancellation (``CANCELLED``).
        """
        for attempt in range(max(1, self.config.max_attempts)):
            seed = SeedPath(run_seed=self.config.run_seed, purpose=self.config.purpose, index=index, attempt=attempt)
            result = self.run_attempt(seed, cancelled)
            if result.outcome == "success":
                break
        return result

    def run_attempt(self, seed: SeedPath, cancelled: Callable[[], bool] = lambda: False) -> EpisodeResult:
        """Run one episode with the actor. Returns and raises as `run_index` does."""
        actor, play = self.ports.actor, self.play(seed, cancelled)
        try:
            request = next(play)
            while True:
                try:
                    answer = _answer(actor, request)
                except BaseException as error:
                    request = play.throw(error)
                else:
                    request = play.send(answer)
        except StopIteration as end:
            result: EpisodeResult = end.value
            return result

    def play(self, seed: SeedPath, cancelled: Callable[[], bool] = lambda: False) -> Play:
        """Run one episode whose actions come from outside.

        Args:
            seed: Seed path of the episode.
            cancelled: Called before every tick; True cancels the episode.

        Yields:
            First an `EpisodeStart`, whose answer is None, then an `ObservationWindow` whenever actions are due. Faults
            of the actor are thrown in; closing the generator drops the episode.

        Returns:
            The result; without any request if the episode cannot begin.

        Raises:
            RoboximError: On a fault of sim, judge or recorder, or on cancellation (``CANCELLED``).
        """
        started = self.ports.clock()
        try:
            draw = self.ports.scenes.draw(seed, self.config.task_config)
        except RoboximError as error:
            if error.code != ErrorCode.RESET_INFEASIBLE:
                raise
            return _infeasible(seed, str(error))
        scene = configure_scene(draw.scene, self.config, self.description)
        semantics = executed_semantics(scene, self.description)
        info = EpisodeInfo(
            episode_id=episode_id(seed), run_seed=seed.run_seed, purpose=seed.purpose, index=seed.index,
            attempt=seed.attempt, task=draw.task, scene=scene, semantics=semantics, actor=self.description.name,
            actor_version=self.description.version, actor_privileged=self.description.privileged,
            renderer=self.ports.sim.renderer, versions=self.versions,
            models=self._library.hashes(scene) if self._library else {},
            config_json=f'{{"run":{to_json(replace(self.config, output_dir=""))},"task":{draw.config_json}}}',
            recorded=recorded_parameters(draw.task, scene),
        )  # fmt: skip
        limit = self.config.max_steps or draw.max_steps
        if not self.config.max_steps and scene.control_rate_hz != draw.scene.control_rate_hz:
            limit = ticks(draw.max_steps / draw.scene.control_rate_hz, scene.control_rate_hz)  # the same duration
        episode = _Episode(self, info, seed, limit, cancelled)
        try:
            return (yield from episode.run(started))
        except BaseException:
            self.ports.recorder.abort()
            raise
        finally:
            self.ports.sim.release(info.episode_id)


def _answer(actor: ActorPort, request: Request) -> ActionChunk | None:
    """Return an actor's answer to an episode's request."""
    if isinstance(request, EpisodeStart):
        actor.reset(request)
        return None
    return actor.act(request)


def _infeasible(seed: SeedPath, message: str, task: TaskSpec | None = None) -> EpisodeResult:
    """Return the result of an episode that did not begin; None as the task means that none was drawn."""
    return EpisodeResult(
        episode_id=episode_id(seed), index=seed.index, attempt=seed.attempt, outcome="error",
        reason="reset_infeasible", message=message,
        instruction=task.instruction if task else "", skill=task.skill if task else "",
    )  # fmt: skip


class _Episode:
    """One running episode."""

    def __init__(
        self, runner: EpisodeRunner, info: EpisodeInfo, seed: SeedPath, max_steps: int, cancelled: Callable[[], bool]
    ) -> None:
        self.runner = runner
        self.ports = runner.ports
        self.config = runner.config
        self.description = runner.description
        self.info = info
        self.seed = seed
        self.max_steps = max_steps
        self.cancelled = cancelled
        self.source = seed.of_task(info.task.drawn)
        self.noise_rng = self.source.rng("execution_noise")
        self.window = _Window(self.config.window or self.description.window)
        self.acting = Acting(self.description, self.config, info.scene, info.semantics)
        self.counts: Counter[str] = Counter()
        self.inference_s = 0.0
        self.last_inference_s = 0.0
        self.received: tuple[str, ...] = ()

    def run(self, started: float) -> Play:
        ports, info = self.ports, self.info
        if self.config.records:
            ports.recorder.open(info)
        self.state = ports.sim.load(info.episode_id, info.scene, info.semantics)
        self.verdict = ports.judge.start(info.episode_id, info.task, self.state)
        if refused := start_refusal(info.scene, self.state, self.verdict):
            if self.config.records:
                ports.recorder.abort()
            message = (
                f"the scene of '{info.task.instruction}' breaks constraint {refused.constraint}: {refused.message}"
            )
            return _infeasible(self.seed, message, info.task)
        self._record("start", (), disturbance=False)
        outcome, reason, message = yield from self._act_until_end()
        if outcome != "error":
            self._settle()
            outcome, reason = self._after_settling(outcome, reason)
        result = EpisodeResult(
            episode_id=info.episode_id, index=info.index, attempt=info.attempt, outcome=outcome, reason=reason,
            message=message, steps=self.counts["steps"], last_seq=self.state.seq, clipped=self.counts["clipped"],
            success_ever=self.verdict.success_ever, recovered=bool(self.counts["recovery"]), verdict=self.verdict,
            instruction=info.task.instruction, skill=info.task.skill, inference_s=self.inference_s,
            final_state_hash=self.state.state_hash, timing=self.config.timing, held=self.counts["held"],
            delay_ticks=float(np.mean(self.acting.delays or [0])),
            wall_s=ports.clock() - started,
        )  # fmt: skip
        if self.config.records:
            keep = "keep" if self.config.keep == "all" or outcome == "success" else "set_apart"
            result = replace(result, bag=ports.recorder.close(result, keep, self.received))
        return result

    def _after_settling(self, outcome: str, reason: str) -> tuple[str, str]:
        """Return the final outcome and reason after the settle phase."""
        if reason == LEFT_WORKSPACE:  # this failure is final, regardless of what happens to the objects afterwards
            return outcome, reason
        if self.verdict.success:
            again = self.config.keep == "first_try" and self.counts["recovery"]
            return ("failure", RECOVERED) if again else ("success", "")
        if outcome == "success":
            return "failure", self.verdict.reason or "not_stable"
        return outcome, self.verdict.reason or reason

    def _act_until_end(self) -> Generator[Request, ActionChunk | None, tuple[str, str, str]]:
        """Act until success, failure, the action limit or a policy fault; return outcome, reason, message."""
        start = EpisodeStart(
            episode_id=self.info.episode_id, instruction=self.info.task.instruction,
            seed=self.source.derived_seed("policy"),
            task=self.info.task if self.description.privileged else None,
            scene=self.info.scene if self.description.privileged else None,
        )  # fmt: skip
        try:
            yield from self._warm_up(start)
            yield start
            while True:
                if self.cancelled():
                    raise RoboximError(f"episode {self.info.episode_id} was cancelled", ErrorCode.CANCELLED)
                if self.state.left_workspace and self.info.scene.workspace.on_leave == "fail":
                    return "failure", LEFT_WORKSPACE, ""
                if self.verdict.success and self.config.stop_on_success:
                    return "success", "", ""
                if self.verdict.failed:
                    return "failure", self.verdict.reason or "failed", ""
                if self.counts["steps"] >= self.max_steps:
                    return "failure", "max_steps", ""
                self._observe()
                if self.state.seq < len(self.runner.repeat):
                    action = np.array(self.runner.repeat[self.state.seq], np.float32)
                    self._tick(TickAction(action=action))
                    continue
                if self.acting.finished(self.state.seq):
                    return "failure", "actor_finished", ""
                if self.acting.due(self.state.seq):
                    yield from self._request_chunk()
                self._tick(self.acting.action(self.state))
        except (PolicyError, InvalidRequestError) as error:
            if isinstance(error, InvalidRequestError) and error.code != ErrorCode.INVALID_ACTION:
                raise
            return "error", error.code.name.lower(), str(error)

    def _observe(self) -> None:
        cameras = tuple(camera.name for camera in self.description.cameras)
        observation = self.ports.sim.observe(self.state, cameras)
        missing = [name for name in cameras if name not in observation.images]
        if missing or observation.seq != self.state.seq:
            raise EvaluationError(
                f"the observation of tick {self.state.seq} lacks {missing or 'everything'} "
                f"(got tick {observation.seq}); the sim must publish every camera of the scene at every tick",
                ErrorCode.OBSERVATION_MISSING,
            )
        if self.description.privileged:
            observation = replace(observation, state=self.state)
        self.window.add(observation)

    def _warm_up(self, start: EpisodeStart) -> Generator[Request, ActionChunk | None, None]:
        """In real time, ask once before the first episode: loading and compiling must not count as thinking time."""
        if self.config.real_time and not self.runner.warm:
            yield start
            self._observe()
            yield self.window.request(self.info)
            self.window = _Window(self.config.window or self.description.window)
        self.runner.warm = True

    def _request_chunk(self) -> Generator[Request, ActionChunk | None, None]:
        before = self.ports.clock()
        commanded = self.state.robot.gripper_command if self.counts["steps"] else None
        chunk = yield self.window.request(self.info, commanded)
        self.last_inference_s = self.ports.clock() - before
        self.inference_s += self.last_inference_s
        answer = checked_answer(chunk, self.description)
        self.received = answer.received or self.received
        self.acting.add(answer, self.state, self.last_inference_s)

    def _tick(self, chosen: TickAction) -> None:
        label, phase = chosen.action, chosen.phase
        executed = label
        share = {FREE: 1.0, DESCENT: self.config.noise_descents}.get(phase, 0.0)
        scale = share * np.array([self.config.noise_translation_m] * 3 + [self.config.noise_rotation_rad] * 3 + [0.0])
        noisy = bool(scale.any())
        if noisy:
            executed = (label + self.noise_rng.normal(size=7) * scale).astype(np.float32)
        self._advance(executed)
        self.counts["steps"] += 1
        self.counts["recovery"] += phase == RECOVERY
        self.counts["held"] += chosen.held
        self._record("act", tuple(float(value) for value in label), disturbance=noisy)

    def _settle(self) -> None:
        """Hold still, so that the judge sees a world at rest."""
        for _ in range(self.config.settle_ticks or ticks(SETTLE_S, self.info.scene.control_rate_hz)):
            hold = holding_action(self.state, self.info.semantics)
            self._advance(hold)
            self.last_inference_s = 0.0
            self._record("settle", tuple(float(value) for value in hold), disturbance=False)

    def _advance(self, executed: ActionArray) -> None:
        seq = self.state.seq + 1
        self.runner.progress = (self.info.episode_id, seq)
        if self.config.records:  # only now: the recorder writes while the actor acts
            self.ports.recorder.wait_written()
        self.state = self.ports.sim.tick(self.info.episode_id, seq, executed)
        self.counts["clipped"] += self.state.clipped
        self.verdict = self.ports.judge.judge(self.state)

    def _record(self, phase: str, label: tuple[float, ...], *, disturbance: bool) -> None:
        if not self.config.records:
            return
        self.ports.recorder.step(
            EpisodeStep(
                episode_id=self.info.episode_id,
                seq=self.state.seq,
                stamp_ns=self.state.stamp_ns,
                phase=phase,
                action_label=label,
                action_executed=self.state.action_executed,
                disturbance=disturbance,
                verdict=self.verdict,
                inference_s=self.last_inference_s,
            )  # fmt: skip
        )
