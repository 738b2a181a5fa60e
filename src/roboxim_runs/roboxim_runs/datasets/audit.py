"""Audits bags and datasets: finds faults that spoil training data, and reports them with pictures.

The checks are those of `roboxim_datasets.audit`. Bags hold the state of the scene, so `runs.audit_truth` measures
ground truth from them; a dataset has it where its bags are given. The rest is checked on the dataset alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from roboxim_bringup.cores import CoreSegmentation
from roboxim_core.errors import ConfigError, RecorderError, RoboximError
from roboxim_core.kinematics import ArmKinematics, Arms
from roboxim_core.models.library import ModelLibrary
from roboxim_core.plain_data.shell import shell_line
from roboxim_core.user_folders import expanded
from roboxim_datasets.audit import AUDIT_CHECKS, AuditEpisode, Auditor, AuditResult, Finding
from roboxim_datasets.audit.report import AuditReport, Picture, write_audit
from roboxim_datasets.audit.values import NO_EXPECTED
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.episode import Episode, whole_id
from roboxim_datasets.formats import open_dataset
from roboxim_recorder.bag import BagReader
from roboxim_recorder.bag_writer import disk_errors
from roboxim_recorder.export.episodes import bag_episode
from roboxim_recorder.export.sources import Source
from roboxim_recorder.run_bags import holds_bags, list_bags, run_bags
from roboxim_runs.datasets.action_decoding import dataset_convention
from roboxim_runs.datasets.audit_expected import NO_BAG, Expected, expected_of_bags, expected_of_dataset, relabels
from roboxim_runs.datasets.audit_truth import BagTruth, TruthPorts
from roboxim_runs.events import OnEvent, Reporter, ignore
from roboxim_runs.executors import Cancellation
from roboxim_runs.storage.folder import checked_path
from roboxim_sim.world import World

PICTURED_TICKS = 4
"""Most ticks of a finding that are shown."""
PICTURED_CAMERAS = 3
"""Most cameras of a finding that are shown."""
OTHER_RATE = "its bag has another number of ticks: the dataset was subsampled or cut"


@dataclass(frozen=True, kw_only=True)
class AuditConfig:
    """What to check."""

    checks: tuple[str, ...] = ()
    """Names of checks; empty: all."""
    bags: tuple[Path, ...] = ()
    """Runs, folders of bags or bags in which a dataset's episodes are looked up, for the checks that need ground
    truth."""
    against: Path | None = None
    """Another dataset of the same episodes, with the expected values; none: those of the bags, if given."""
    render: bool = True
    """Whether to render segmentation images, for the checks of visibility and colours."""
    replay: bool = False
    """Whether to execute the bags' actions again."""
    episodes: int = 0
    """Number of episodes to check, from the first; 0: all."""
    pictures: int = 3
    """Number of findings per check that are shown with pictures."""

    def __post_init__(self) -> None:
        """Check names and numbers.

        Raises:
            ConfigError: On an unknown check, or a negative number.
        """
        for name in self.checks:
            AUDIT_CHECKS[name]
        if self.against is not None and self.bags:
            raise ConfigError("give bags or another dataset, not both: each defines the expected values")
        for name in ("episodes", "pictures"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name} must be >= 0, got {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True)
class Audited:
    """A finished audit."""

    result: AuditResult
    """What was found."""
    page: Path | None
    """The report, ``report.html``; ``audit.json`` is beside it. None: no folder was given."""


@dataclass(frozen=True, kw_only=True)
class _Entry:
    """An episode that is to be audited."""

    name: str
    split: str = ""
    episode: Episode | None = None
    bag: Path | None = None
    no_bag: str = ""
    exact_images: bool = False
    relabelled: str = ""
    prompt: Callable[[str], str] = str


def audit_dataset(
    path: Path | str,
    out: Path | str | None = None,
    config: AuditConfig | None = None,
    *,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
) -> Audited:
    """Audit a run, a folder of bags, a bag, or a dataset of any registered format.

    Args:
        path: The bags or the dataset.
        out: Folder for the report, ``report.html`` and ``audit.json``; none: nothing is written.
        config: What to check; none: everything that needs no simulation.
        on_event: Receives the run's events.
        cancellation: Ends the audit when it is set.

    Raises:
        CancelledError: When the audit was cancelled.
        ConfigError: When the path is neither bags nor a dataset, its convention or edits are not valid, or a check is
            unknown.
        RecorderError: When the dataset's description is damaged, or the report cannot be written. An unreadable episode
            is reported; the others are audited.
    """
    path, config = expanded(path), config or AuditConfig()
    if out is not None:
        checked_path(out)
    total, entries, expected = _entries(path, config)
    auditor, pictures = Auditor(config.checks), _Pictures(config.pictures if out is not None else 0)
    sources: dict[str, str] = {}
    reporter = Reporter(on_event, cancellation)
    with ExitStack() as stack, reporter.resumable("the same call or command starts again"):
        ports = _ports(config, stack)
        progress = stack.enter_context(reporter.stage("auditing", total, "episodes"))
        reporter.require_wanted()
        for done, entry in enumerate(entries, start=1):
            try:
                episode = _episode(entry, ports, expected)
            except RoboximError as error:
                auditor.add_unreadable(entry.name, str(error))
            else:
                sources[entry.name] = episode.source
                pictures.take(episode, auditor.add(episode))
            progress(done)
    if isinstance(expected, Expected) and not config.episodes:
        auditor.note("content", _missing(expected))
    result = auditor.result()
    if out is None:
        return Audited(result=result, page=None)
    folder = expanded(out)
    report = AuditReport(
        title=f"Audit of {path}",
        result=result,
        pictures=pictures.taken,
        sources={name: source for name, source in sources.items() if source},
        facts=_facts(path, config, result),
        versions={"roboxim": version("roboxim")},
        command=_command(path, out, config),
    )
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        return Audited(result=result, page=write_audit(report, folder))


def _ports(config: AuditConfig, stack: ExitStack) -> TruthPorts:
    library = ModelLibrary()
    segmentation = CoreSegmentation(library) if config.render else None
    if segmentation is not None:
        stack.callback(segmentation.close)
    sim = World(library) if config.replay else None
    if sim is not None:
        stack.callback(sim.close)
    return TruthPorts(library=library, segmentation=segmentation, sim=sim, arms=Arms(library))


# ------------------------------------------------------------------ episodes


def _entries(path: Path, config: AuditConfig) -> tuple[int, Iterator[_Entry], Expected | str]:
    """Return the number of episodes, the episodes one after another, and what they should be or why nothing says it."""
    if not path.exists():
        raise ConfigError(f"no such folder: {path}; expected a run, a folder of bags, or a dataset")
    max_entries = config.episodes or None
    if holds_bags(path):
        bags = ([path] if path.is_file() else list(run_bags(path).paths))[:max_entries]
        why = "bags are the reference; a dataset is compared with them"
        return len(bags), (_Entry(name=bag.name, bag=bag, exact_images=True) for bag in bags), why
    dataset = open_dataset(path)
    count = min(len(dataset), max_entries or len(dataset))
    found = _Bags(config.bags)
    expected: Expected | str = NO_EXPECTED
    if config.against is not None:
        expected = expected_of_dataset(dataset, open_dataset(config.against))
    elif config.bags:
        expected = expected_of_bags(dataset, found.paths)
    return count, _of_dataset(dataset, count, found), expected


def _missing(expected: Expected) -> Iterator[Finding]:
    """Yield the episodes that an export of the bags gives and the dataset lacks."""
    for name in sorted(expected.unclaimed):
        yield Finding(text=f"an export of the bags has episode {name}, the dataset has not", episodes=(name,))


def _of_dataset(dataset: Dataset, count: int, bags: _Bags) -> Iterator[_Entry]:
    words, convention = relabels(dataset), dataset_convention(dataset.folder)
    prompt: Callable[[str], str] = convention.prompt.text if convention else str
    for number in range(count):
        split, index = dataset.place(number)
        name = f"{split}/{index}"
        try:
            episode = dataset.episode(number)
        except RecorderError as error:
            yield _Entry(name=name, split=split, no_bag=str(error))
            continue
        bag, why = bags.find(episode)
        exact = dataset.features.lossless
        yield _Entry(
            name=name, split=split, episode=episode, bag=bag, no_bag=why, exact_images=exact,
            relabelled=words(episode.episode_id), prompt=prompt,
        )  # fmt: skip


PART_OF = "it has the steps of one actor of {}, and ground truth needs all of them"
"""Why a stretch of an episode has no ground truth beside the values that an export gives."""


class _Bags:
    """Bags by episode id."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._given = bool(folders)
        self.paths: dict[str, list[Path]] = {}
        for folder in folders:
            for bag in [folder] if folder.is_file() else list_bags(folder):
                name = bag.parent.name if bag.is_file() else bag.name
                self.paths.setdefault(name, []).append(bag)

    def find(self, episode: Episode) -> tuple[Path | None, str]:
        """Return the bag of a dataset's episode, or why there is none."""
        if not self._given:
            return None, ""
        wanted = episode.metadata.get("final_state_hash")
        name = whole_id(episode.episode_id)
        for bag in self.paths.get(name, ()):
            try:
                if wanted is None or BagReader(bag).result.final_state_hash == wanted:
                    return (bag, "") if name == episode.episode_id else (None, PART_OF.format(bag))
            except RecorderError:
                continue
        return None, NO_BAG


def _episode(entry: _Entry, ports: TruthPorts, expected: Expected | str) -> AuditEpisode:
    """Return an episode with its ground truth.

    Raises:
        RoboximError: When it cannot be read.
    """
    truth = None
    if entry.bag is not None:
        truth = BagTruth(entry.bag, ports, entry.episode)
    episode = entry.episode
    if episode is None:
        if truth is None or entry.bag is None:
            raise RecorderError(entry.no_bag)
        source = Source(path=entry.bag, info=truth.info, result=truth.result)
        episode = bag_episode(source, truth.joint_names)
    made = AuditEpisode(
        name=entry.name, split=entry.split, episode=episode, source=str(entry.bag or ""), relabelled=entry.relabelled,
        prompt=entry.prompt,
    )  # fmt: skip
    made.no_truth = entry.no_bag or made.no_truth
    made.arm, made.exact_images = _arm(episode, ports), entry.exact_images
    if isinstance(expected, str):
        made.no_expected = expected
    else:
        made.expected, made.lossless = expected.find(episode, entry.name), expected.lossless
        made.unexpected = "" if made.expected is not None else expected.missing
        expected.unclaimed.discard(episode.episode_id)
    if truth is not None:
        if truth.steps == len(episode):
            made.truth = truth.measure()
        else:
            made.no_truth = OTHER_RATE
    return made


def _arm(episode: Episode, ports: TruthPorts) -> ArmKinematics | None:
    """Return the arm of an episode; None: the robot or the order of its joints is not known."""
    if episode.robot not in ports.library.robot_ids:
        return None
    arm = ports.arms[episode.robot]
    return arm if tuple(episode.joint_names) == tuple(arm.model.joint_names) else None


# ------------------------------------------------------------------ report


class _Pictures:
    """Takes the pictures of the first findings of each check."""

    def __init__(self, max_pictures: int) -> None:
        self._max_pictures = max_pictures
        self._pictured: Counter[str] = Counter()
        self._found: Counter[str] = Counter()
        self.taken: dict[tuple[str, int], list[Picture]] = {}

    def take(self, episode: AuditEpisode, found: Iterable[tuple[str, Finding]]) -> None:
        """Take the pictures of an episode's findings."""
        wanted: dict[tuple[str, int], set[tuple[str, int]]] = {}
        for check, finding in found:
            number = self._found[check]
            self._found[check] += 1
            cameras = [c for c in finding.cameras or episode.episode.cameras if c in episode.episode.cameras]
            if self._pictured[check] < self._max_pictures and cameras and finding.ticks:
                self._pictured[check] += 1
                last = len(episode.episode) - 1
                ticks = {min(tick, last) for tick in finding.ticks[:PICTURED_TICKS]}
                wanted[check, number] = {(c, tick) for c in cameras[:PICTURED_CAMERAS] for tick in ticks}
        if wanted:
            self._read(episode.episode, wanted)

    def _read(self, episode: Episode, wanted: Mapping[tuple[str, int], set[tuple[str, int]]]) -> None:
        places = set().union(*wanted.values())
        cameras = sorted({camera for camera, _ in places})
        shown = {}
        for step in episode.steps(cameras):
            for camera in cameras:
                if (camera, step.index) in places:
                    shown[camera, step.index] = Picture.of(camera, step.index, step.images[camera])
        for key, of_finding in wanted.items():
            self.taken[key] = [shown[place] for place in sorted(of_finding)]


def _facts(path: Path, config: AuditConfig, result: AuditResult) -> dict[str, str]:
    return {
        "audited": str(path),
        "episodes": str(result.episodes),
        "steps": str(result.steps),
        "expected values": str(config.against or ", ".join(map(str, config.bags)) or "unknown"),
        "ground truth": "bags" if holds_bags(path) else ", ".join(map(str, config.bags)) or "none",
        "visibility and colours": "rendered" if config.render else "not rendered",
        "replay": "executed again" if config.replay else "not executed",
    }


def _command(path: Path, out: Path | str | None, config: AuditConfig) -> str:
    words = ["roboxim", "dataset", "audit", str(path)]
    words += [word for name in config.checks for word in ("--check", name)]
    words += [word for folder in config.bags for word in ("--bags", str(folder))]
    words += ["--against", str(config.against)] if config.against is not None else []
    words += ["--replay"] * config.replay + ["--no-render"] * (not config.render)
    words += ["--episodes", str(config.episodes)] if config.episodes else []
    words += ["--out", str(out)] if out is not None else []
    return shell_line(*words)
