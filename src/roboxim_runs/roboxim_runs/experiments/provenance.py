"""Where an experiment's results come from: code, packages, machine, files, and what is attested about trainings."""

from __future__ import annotations

import hashlib
import platform
import subprocess
import sysconfig
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from roboxim_core.config import from_plain, load_yaml
from roboxim_core.errors import ConfigError, one_of
from roboxim_eval.experiments import Design
from roboxim_eval.experiments.card import ARGUMENTS, Attestation, CardCode, sha256_of
from roboxim_runs.storage.store import file_sha256

ATTEST_FILE = "attest.yaml"
ORIGIN = "ran"
"""Key of a line of ``stages.jsonl`` with what the stage ran with, an `Origin`."""
TEMPLATE = {"model": "", "steps": 0, "batch": 0, "learning_rate": 0.0}
"""Recipe to fill in: these values of these keys say nothing, as do an empty text and null of others."""
UNKNOWN = "unknown"
"""How statements name what lines of older versions do not state."""


@lru_cache(maxsize=1)
def code() -> CardCode:
    """Return the version of RoboXim, and the commit of the repository that it runs from, if any."""
    folder = Path(__file__).resolve().parent

    def git(*words: str) -> str:
        command = ["git", "-C", str(folder), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout.strip()

    version = metadata.version("roboxim")
    try:
        inside = git("ls-files", "--error-unmatch", Path(__file__).name)
        commit, dirty = (git("rev-parse", "HEAD"), bool(git("status", "--porcelain"))) if inside else ("", False)
    except (OSError, subprocess.SubprocessError):
        return CardCode(version=version)
    return CardCode(version=version, commit=commit, dirty=dirty)


@lru_cache(maxsize=1)
def packages_sha256() -> str:
    """Return the hash of the names and versions of all packages of this environment.

    Packages that a library carries along and adds to the path, as Ray does once it runs, do not count.
    """
    folders = [sysconfig.get_path(name) for name in ("purelib", "platlib")]
    found = metadata.distributions(path=folders)
    return sha256_of(sorted({f"{d.metadata['Name']}=={d.version}".lower() for d in found}))


def device(proc: Path = Path("/proc")) -> str:
    """Return the machine's processor and its NVIDIA GPUs, e.g. ``AMD EPYC, NVIDIA H100 80GB HBM3``.

    Args:
        proc: Files in which the kernel and the GPUs' driver describe the machine.
    """
    processors = _values(proc / "cpuinfo", "model name") or [platform.machine()]
    gpus = sorted(proc.glob("driver/nvidia/gpus/*/information"))
    return ", ".join([processors[0], *(name for file in gpus for name in _values(file, "Model"))])


def _values(file: Path, key: str) -> list[str]:
    """Return the values of a key in a file with lines ``key : value``; none where it cannot be read."""
    try:
        lines = file.read_text().splitlines()
    except OSError:
        return []
    parts = [line.partition(":") for line in lines]
    return [value.strip() for name, _, value in parts if name.strip() == key]


# ------------------------------------------------------------------ stages


@dataclass(frozen=True, kw_only=True)
class Origin:
    """What a stage ran with, stored when it is finished: a later call may have other code."""

    code: CardCode = CardCode()
    """The code."""
    packages_sha256: str = ""
    """Hash of the installed packages, see `packages_sha256`."""
    renderer: str = ""
    """Renderer of its images; empty: it draws none."""
    device: str = ""
    """Machine of the command, or that of a training elsewhere, see `device`; empty: an earlier version wrote the line,
    which did not store it."""

    @staticmethod
    def here(renderer: str = "") -> Origin:
        """Return what a stage of this process runs with.

        Args:
            renderer: Renderer of its images; empty: it draws none.
        """
        return Origin(code=code(), packages_sha256=packages_sha256(), renderer=renderer, device=device())

    @staticmethod
    def of(entry: Mapping[str, Any]) -> Origin | None:
        """Return what a line of ``stages.jsonl`` states; none: a version wrote it that did not store this.

        Raises:
            ConfigError: When the line is damaged.
        """
        if ORIGIN not in entry:
            return None
        found: Origin = from_plain(entry[ORIGIN], Origin, source=f"stage '{entry.get('stage', '')}'")
        return found


def origin_statements(origins: Mapping[str, Origin | None], renderers: Mapping[str, str]) -> Iterator[str]:
    """Yield a sentence for each of code, packages, machine and renderer that stages of an experiment do not share.

    Args:
        origins: Stage to what it ran with; none: unknown.
        renderers: Stage that draws images to its renderer.
    """
    known = {name: origin for name, origin in origins.items() if origin is not None}
    codes = {name: known[name].code.words if name in known else UNKNOWN for name in origins}
    packages = {name: known[name].packages_sha256[:16] if name in known else UNKNOWN for name in origins}
    machines = {name: origin.device for name, origin in known.items() if origin.device}
    shared = {
        "versions of the code": codes, "sets of packages": packages, "renderers": renderers, "machines": machines
    }  # fmt: skip
    for what, values in shared.items():
        stages: dict[str, list[str]] = {}
        for name, value in values.items():
            stages.setdefault(value, []).append(name)
        if len(stages) > 1:
            shown = (f"{value} ({_first_of(names)})" for value, names in stages.items())
            yield f"stages ran with {len(stages)} {what}: {', '.join(shown)}"


def _first_of(names: list[str]) -> str:
    """Return the first of several names, and the number of the others."""
    return names[0] + (f" and {len(names) - 1} more" if len(names) > 1 else "")


# ------------------------------------------------------------------ files


def folder_sha256(folder: Path) -> str:
    """Return the hash of the names and contents of a folder's files, hidden ones left out; empty: no such folder."""
    if not folder.is_dir():
        return ""
    content = hashlib.sha256()
    for file in sorted(folder.rglob("*")):
        parts = file.relative_to(folder).parts
        if file.is_file() and not any(part.startswith(".") for part in parts):
            content.update(f"{'/'.join(parts)}\0{file_sha256(file)}\n".encode())
    return content.hexdigest()


@dataclass(frozen=True, kw_only=True)
class Attestations:
    """What is attested about an experiment's trainings: the file ``OUT/attest.yaml``.

    Its keys hold for all trainings; those below ``trainings: CONDITION[.R]`` replace them::

        recipe: {model: octo-small-1.5, steps: 10000, learning_rate: 3e-5, batch: 128}
        pretraining: octo-small-1.5
        exposure: unknown
        trainings:
          baseline: {recipe: {steps: 8000}}
    """

    recipe: dict[str, Any] = field(default_factory=dict)
    """See `roboxim_eval.experiments.card.Attestation`; the keys of a training are added to these."""
    pretraining: str = ""
    """Weights that the trainings started from; empty: not stated."""
    exposure: str = "unknown"
    """Whether they had seen held-out combinations: ``no``, ``yes`` or ``unknown``."""
    trainings: dict[str, dict[str, Any]] = field(default_factory=dict)
    """``CONDITION`` or ``CONDITION.R`` to the keys that differ, ``dataset_sha256`` among them."""

    @staticmethod
    def of(out: Path, design: Design) -> Attestations:
        """Return those of a run's folder, or those that follow from the commands of its trainings.

        Raises:
            ConfigError: When the file is invalid.
        """
        path = out / ATTEST_FILE
        if path.exists():
            found: Attestations = from_plain(load_yaml(path), Attestations, source=str(path))
            return found
        trainer, own = design.trainer, design.trainer.is_own
        differing = {t.condition: t.arguments for t in design.trainings} if trainer.command else {}
        recipes = {n: {"recipe": {ARGUMENTS: text or "none"}} for n, text in differing.items()}
        return Attestations(
            recipe={"command": trainer.command} if trainer.command else {}, pretraining="none" if own else "",
            exposure="no" if own else "unknown", trainings=recipes if any(differing.values()) else {},
        )  # fmt: skip

    def training(self, name: str, *, steps: int, dataset_sha256: str, here: bool = True) -> Attestation:
        """Return what is attested about a training.

        Args:
            name: ``CONDITION.R``.
            steps: Its training steps as planned; 0: unknown.
            dataset_sha256: Hash of the dataset that was exported for it; empty: unknown.
            here: Whether a command of this run trained it, so that its steps and dataset are known. Facts that were not
                stated about a training elsewhere are left out.

        Raises:
            ConfigError: When a key is wrong, or the training used another dataset than it was given.
        """
        known = {"steps": steps} if steps and here else {}
        attested = {"recipe": {**known, **self.recipe}, "pretraining": self.pretraining, "exposure": self.exposure}
        for key in (name.rpartition(".")[0], name):
            own = dict(self.trainings.get(key, {}))
            recipe = own.pop("recipe", {})
            if not isinstance(recipe, Mapping):
                raise ConfigError(f"{ATTEST_FILE}: trainings.{key}.recipe must be a mapping, got {recipe!r}")
            attested = {**attested, **own, "recipe": {**attested["recipe"], **recipe}}  # type: ignore[dict-item]
        attest: Attestation = from_plain(attested, Attestation, source=f"{ATTEST_FILE}, training {name}")
        recipe = {key: value for key, value in attest.recipe.items() if value not in ("", None, TEMPLATE.get(key))}
        if attest.dataset_sha256 and dataset_sha256 and attest.dataset_sha256 != dataset_sha256:
            raise ConfigError(
                f"{ATTEST_FILE}: training {name} used a dataset with hash {attest.dataset_sha256}, not the one that "
                f"was exported for it ({dataset_sha256}); train it again, or name the right training"
            )
        return replace(
            attest, recipe=recipe, dataset_sha256=attest.dataset_sha256 or (dataset_sha256 if here else "")
        )  # fmt: skip

    def require_known(self, names: tuple[str, ...]) -> None:
        """Refuse attestations of trainings that the experiment does not have.

        Raises:
            ConfigError: Naming the first one.
        """
        known = {*names, *(name.rpartition(".")[0] for name in names)}
        for name in self.trainings:
            if name not in known:
                raise ConfigError(f"{ATTEST_FILE}: no training '{name}'; {one_of(sorted(known), name)}")


def attestation_template(names: tuple[str, ...]) -> str:
    """Return the text of an ``attest.yaml`` to fill in, for policies that are trained elsewhere."""
    content = {
        "recipe": dict(TEMPLATE),
        "pretraining": "",
        "exposure": "unknown",
        "trainings": {name: {"dataset_sha256": ""} for name in names},
    }
    text: str = yaml.safe_dump(content, sort_keys=False)
    return (
        "# What cannot be seen in the data. The card and the report state it, and warn of what is left at 0 or ''.\n"
        "# recipe: everything besides dataset and seed; equal in all conditions, or the report flags it.\n"
        "# pretraining: weights that the training started from, or none. exposure: no, yes or unknown.\n" + text
    )
