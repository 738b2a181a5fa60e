"""Values that the episode loop receives, sends to the recorder, and returns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from roboxim_core import limits
from roboxim_core.actions import ActionSemantics, Chunking, GripperRule
from roboxim_core.errors import InvalidRequestError, counted, one_of
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.verdicts import Verdict

KEEP_RULES = ("successful", "first_try", "all", "none")
POLICY_DIED = "policy_died"
"""Reason of an episode whose policy was lost: its server or its process was gone."""
WORKER_DIED = "worker_died"
"""Reason of an episode that ended every process that tried to run it."""
NOT_PLAYED = frozenset({POLICY_DIED, WORKER_DIED})
"""Reasons of episodes that the policy did not play to their end. They do not count as results."""


LIMITS = {
    "image_width": limits.IMAGE_PX,
    "image_height": limits.IMAGE_PX,
    "rate_hz": limits.PHYSICS_RATE_HZ[1],
    "window": limits.WINDOW,
    "execute": limits.EPISODE_STEPS,
    "latency_ticks": limits.EPISODE_STEPS,
    "gripper_band": 1.0,
    "gripper_agree": 1_000,
    "max_steps": limits.EPISODE_STEPS,
    "settle_ticks": limits.EPISODE_STEPS,
    "max_attempts": limits.ATTEMPTS,
    "policy_timeout_s": limits.POLICY_TIMEOUT_S,
    "noise_translation_m": 1.0,
    "noise_rotation_rad": 1.0,
    "noise_descents": 1.0,
}
"""Largest values of the fields of a run's configuration, by name."""


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Configuration of a run of episodes."""

    run_seed: int = 0
    """Seed of the run."""
    purpose: str = "eval"
    """``demo``, ``eval``, ``train`` or ``test``."""
    actor: str = "expert"
    """Namespace of the policy, e.g. ``expert`` or ``policy``."""
    task_config: str = ""
    """Task configuration as YAML text; empty: the task node's default."""
    cameras: tuple[str, ...] = ()
    """Names of the scene's cameras to keep; empty: all."""
    image_width: int = 0
    """Overrides the width [px] of cameras for which the policy states none; 0: as configured."""
    image_height: int = 0
    """Overrides the height [px] of cameras for which the policy states none; 0: as configured."""
    depth: bool = False
    """Whether the cameras also publish depth."""
    segmentation: bool = False
    """Whether the cameras also publish segmentation."""
    rate_hz: float = 0.0
    """Control rate [Hz]; 0: the policy's, or the scene's if the policy acts at any rate."""
    window: int = 0
    """Observations per request; 0: the policy's window."""
    execute: int = 0
    """Actions executed per request; 0: as the policy's `Chunking` says."""
    ensemble: str = ""
    """An `Ensemble`; empty: as the policy's `Chunking` says."""
    ensemble_decay: float = 0.0
    """k of the exponential ensemble, with ``ensemble`` only."""
    late_rows: str = ""
    """A `LateRows`; empty: as the policy's `Chunking` says."""
    gripper_band: float = 0.0
    """Makes the gripper binary, with this band, see `GripperRule`; 0: as the policy's rule says."""
    gripper_agree: int = 0
    """Makes the gripper binary, with this agreement, see `GripperRule`; 0: as the policy's rule says."""
    latency_ticks: int = 0
    """Ticks by which every answer is late."""
    real_time: bool = False
    """Whether simulated time passes while the policy computes: an answer that took x s of wall time arrives x s of
    simulated time after its observation, rounded up to ticks. Such a run is not repeatable."""
    max_steps: int = 0
    """Number of actions after which an episode has failed; 0: the skill's limit."""
    stop_on_success: bool = True
    """Whether to stop at the first success."""
    settle_ticks: int = 0
    """Number of hold actions between the end and the final verdict; recorded, not exported; 0: one second of them."""
    keep: str = "all"
    """``successful`` (sets other episodes apart), ``first_try`` (also those that needed a second grasp, which count as
    failures), ``all`` (keeps every episode) or ``none`` (records nothing)."""
    max_attempts: int = 1
    """Largest number of attempts per index until an episode is kept."""
    policy_timeout_s: float = 30.0
    """Longest wait for a policy's answer [s]."""
    noise_translation_m: float = 0.0
    """Standard deviation of the noise injected into free motions, per axis and tick [m]."""
    noise_rotation_rad: float = 0.0
    """The same for rotations [rad]."""
    noise_descents: float = 0.0
    """Share of that noise on descents, until 5 cm before a grasp and 3 cm before a place, 0..1."""
    output_dir: str = ""
    """Folder for bags, absolute; empty: record nothing."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidRequestError: On a negative number, an unknown keep rule, or chunking that contradicts itself.
        """
        if self.keep not in KEEP_RULES:
            raise InvalidRequestError(f"unknown keep rule '{self.keep}'; {one_of(KEEP_RULES, self.keep)}")
        for name, value in vars(self).items():
            if isinstance(value, int | float) and not value >= 0 and name != "ensemble_decay":
                raise InvalidRequestError(f"{name} must be >= 0, got {value}")
        for name, maximum in LIMITS.items():
            limits.require_range(name, getattr(self, name), 0, maximum)
        limits.require_count("cameras", len(self.cameras), limits.CAMERAS)
        if self.ensemble_decay and not self.ensemble:
            raise InvalidRequestError(f"ensemble_decay {self.ensemble_decay:g} needs ensemble 'exponential'")
        self.chunking(Chunking())

    def chunking(self, policy: Chunking) -> Chunking:
        """Return how chunks are executed: the policy's way, with the values that this run sets.

        Raises:
            InvalidRequestError: On an unknown name or values that contradict each other.
        """
        try:
            return policy.overridden(
                execute=self.execute, ensemble=self.ensemble, ensemble_decay=self.ensemble_decay,
                late_rows=self.late_rows,
            )  # fmt: skip
        except ValueError as error:
            raise InvalidRequestError(str(error)) from None

    def gripper(self, policy: GripperRule) -> GripperRule:
        """Return when the gripper switches: the policy's rule, with the values that this run sets."""
        if not self.gripper_band and not self.gripper_agree:
            return policy
        return replace(
            policy, binary=True, band=self.gripper_band or policy.band, agree=self.gripper_agree or policy.agree
        )

    @property
    def timing(self) -> str:
        """When answers arrive, in words: ``lockstep``, ``lockstep, 2 ticks late`` or ``real time``."""
        mode = "real time" if self.real_time else "lockstep"
        late = f", {counted(self.latency_ticks, 'tick')} late" if self.latency_ticks else ""
        return mode + late

    @property
    def records(self) -> bool:
        """Whether bags are written."""
        return bool(self.output_dir) and self.keep != "none"


@dataclass(frozen=True, kw_only=True)
class Draw:
    """Task and scene that the task node drew for an episode."""

    task: TaskSpec
    """The task."""
    scene: SceneSpec
    """The scene."""
    max_steps: int
    """Number of actions after which the skill has failed."""
    config_json: str = "{}"
    """Resolved task configuration."""


@dataclass(frozen=True, kw_only=True)
class EpisodeInfo:
    """Everything needed to reproduce an episode; the first message of its bag."""

    episode_id: str
    """Unique id."""
    run_seed: int
    """Seed of the run."""
    purpose: str
    """Purpose."""
    index: int
    """Index in the run."""
    attempt: int
    """Attempt at this index."""
    task: TaskSpec
    """The task."""
    scene: SceneSpec
    """The scene."""
    semantics: ActionSemantics
    """Meaning of the actions."""
    actor: str
    """Name of the acting policy."""
    actor_version: str = ""
    """Version of the policy; empty: none."""
    actor_privileged: bool = False
    """Whether the policy receives task, scene and state; a policy under test must not."""
    renderer: str = ""
    """Renderer and device."""
    rerendered_from: str = ""
    """Id of the episode whose images were rendered again; empty: the images were recorded live."""
    config_json: str = "{}"
    """Resolved configuration of the run and of the task, for people; programs read the other fields."""
    versions: dict[str, str] = field(default_factory=dict)
    """Package to version."""
    models: dict[str, str] = field(default_factory=dict)
    """Robot or object model to the hash of its files."""
    recorded: dict[str, str] = field(default_factory=dict)
    """Recorded parameter to JSON."""


@dataclass(frozen=True, kw_only=True)
class EpisodeStep:
    """Data that the loop adds to a tick."""

    episode_id: str
    """Episode."""
    seq: int
    """Tick at the end of this step."""
    stamp_ns: int
    """Its stamp [ns]."""
    action_label: tuple[float, ...] = ()
    """Action that imitation learning uses as the label, shape (D,); empty at tick 0."""
    action_executed: tuple[float, ...] = ()
    """Action that the controller integrated, shape (D,); empty at tick 0."""
    phase: str = "act"
    """``start``, ``act`` or ``settle``."""
    disturbance: bool = False
    """Whether noise was injected into the action."""
    verdict: Verdict = Verdict()
    """Verdict at this tick."""
    inference_s: float = 0.0
    """Wall time of the policy request that returned this action [s]; 0 in bags."""


@dataclass(frozen=True, kw_only=True)
class EpisodeResult:
    """How an episode ended."""

    episode_id: str
    """Episode."""
    index: int
    """Index in the run."""
    attempt: int = 0
    """Attempt at this index."""
    outcome: str = "failure"
    """``success``, ``failure`` (not solved) or ``error`` (a misbehaving policy)."""
    reason: str = ""
    """Reason in snake_case; empty on success."""
    message: str = ""
    """Details for a person."""
    steps: int = 0
    """Number of executed actions, settling excluded."""
    last_seq: int = 0
    """Last tick, settling included."""
    success_ever: bool = False
    """Whether the task was solved at any tick."""
    recovered: bool = False
    """Whether the actor needed more than one try, e.g. a second grasp; a success is then not a first-try success."""
    verdict: Verdict = Verdict()
    """Final verdict."""
    clipped: int = 0
    """Number of clipped actions."""
    timing: str = "lockstep"
    """When answers arrived, see `RunConfig.timing`."""
    held: int = 0
    """Number of ticks at which the robot held still because no answer had arrived."""
    delay_ticks: float = 0.0
    """Mean delay from an observation to the arrival of its answer [ticks]."""
    instruction: str = ""
    """The instruction."""
    skill: str = ""
    """The skill."""
    bag: str = ""
    """Path of the bag, relative to the output folder; empty: none."""
    wall_s: float = 0.0
    """Wall time of the episode [s]; 0 in bags."""
    inference_s: float = 0.0
    """Wall time in the policy [s]; 0 in bags."""
    final_state_hash: str = ""
    """State hash of the last tick."""

    @property
    def played(self) -> bool:
        """Whether this counts as a result: false if the policy was lost, which does not measure the policy."""
        return self.reason not in NOT_PLAYED

    @property
    def episode(self) -> str:
        """The episode id without the attempt: equal for all attempts at an index of a run."""
        return self.episode_id.rpartition("-")[0]
