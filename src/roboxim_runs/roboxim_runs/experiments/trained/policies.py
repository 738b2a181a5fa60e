"""The policies of an experiment's evaluations: trained here, trained elsewhere, or given by the user."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from roboxim_bringup.parameters import parse_options
from roboxim_core.errors import ConfigError, one_of
from roboxim_eval.experiments import Design, Stage
from roboxim_eval.experiments.trainers import TrainerConfig
from roboxim_policies.base import find_policy, require_arguments
from roboxim_runs.experiments.trained.exports import convention_file
from roboxim_runs.experiments.trained.servers import Server, server_of
from roboxim_runs.policies.specs import EXPERT, PolicySpec, find_policies


def policy_of(design: Design, stage: Stage, given: Mapping[str, PolicySpec], out: Path) -> PolicySpec | None:
    """Return the policy of an evaluation; none: it is trained elsewhere and not named yet.

    Args:
        design: The experiment.
        stage: The evaluation.
        given: Policies that the user names, by ``CONDITION.REPLICATE``, or by ``CONDITION`` for all replicates.
        out: The experiment's folder.

    Raises:
        ConfigError: When the expert is to receive other words.
    """
    evaluated = _Evaluated.of(design, stage, out)
    if (named := evaluated.named(given)) is not None:
        return named
    if not evaluated.trained_here:
        return None
    policy = PolicySpec(spec=design.trainer.policy, options=design.trainer.filled_options(**evaluated.values))
    return _worded(policy, evaluated.condition, evaluated.instruction)


def is_named(design: Design, stage: Stage, given: Mapping[str, PolicySpec], out: Path) -> bool:
    """Return whether the user names the policy of an evaluation; for the arguments see `policy_of`."""
    return _Evaluated.of(design, stage, out).named(given) is not None


def server_of_policy(design: Design, stage: Stage, given: Mapping[str, PolicySpec], out: Path) -> Server | None:
    """Return the server that an evaluation's checkpoint needs; none: it needs none, or the user named its policy.

    Args:
        design: The experiment.
        stage: The evaluation.
        given: Policies that the user names, see `policy_of`.
        out: The experiment's folder.

    Raises:
        ConfigError: When the trainer's ``serve`` or its ``url`` is wrong.
    """
    evaluated, trainer = _Evaluated.of(design, stage, out), design.trainer
    if not trainer.serve or not evaluated.trained_here or evaluated.named(given) is not None:
        return None
    url = trainer.filled_options(**evaluated.values)["url"]
    return server_of(trainer.serve, url, **evaluated.values)


@dataclass(frozen=True, kw_only=True)
class _Evaluated:
    """The policy that an evaluation asks for."""

    condition: str
    instruction: str | None
    base: str
    """Condition whose checkpoint it is."""
    replicate: str
    step: str
    """Training steps of a checkpoint on the learning curve; empty: the final one."""
    trained_here: bool
    values: dict[str, str]
    """Placeholder of the trainer's options to its value."""

    @staticmethod
    def of(design: Design, stage: Stage, out: Path) -> _Evaluated:
        """Return what an evaluation of an experiment in a folder asks for."""
        name, replicate = stage.name.removeprefix("evaluate/").rsplit(".", 1)
        replicate, _, step = replicate.partition("@")
        condition = design.config.conditions[name]
        base = condition.checkpoint_of or name
        dataset = design.config.conditions[base].train
        trained_here = bool(design.trainer.command and dataset)
        values: dict[str, str] = {}
        if trained_here:
            folder = (out / f"export/{dataset}.{replicate if design.generations > 1 else 0}").resolve()
            options = {**design.trainer.export, **design.config.datasets[dataset].export}
            at = f"@{step}" if step else ""
            values = {
                "checkpoint": str((out / f"train/{base}.{replicate}{at}").resolve()), "dataset": str(folder),
                "convention": str(convention_file(design.trainer.format, options, folder)),
                "condition": base, "replicate": replicate,
            }  # fmt: skip
        return _Evaluated(
            condition=name, instruction=condition.instruction, base=base, replicate=replicate, step=step,
            trained_here=trained_here, values=values,
        )  # fmt: skip

    def named(self, given: Mapping[str, PolicySpec]) -> PolicySpec | None:
        """Return the policy that the user names; none: no one."""
        for key in () if self.step else (f"{self.condition}.{self.replicate}", self.condition):
            if key in given:
                return replace(given[key], name=self.condition)
        for key in (f"{self.base}.{self.replicate}", self.base):
            if key in given:
                return _worded(given[key], self.condition, self.instruction)
        return None


def _worded(policy: PolicySpec, name: str, instruction: str | None) -> PolicySpec:
    """Return a policy that receives another instruction; none: the task's own."""
    if instruction is None:
        return replace(policy, name=name)
    if policy.spec == EXPERT:
        raise ConfigError(f"the expert reads the task, not its words; name another policy with --policy {name}=SPEC")
    options = {**policy.options, "policy": policy.spec, "instruction": instruction}
    return PolicySpec(spec="reworded", name=name, options=options)


def named_policies(words: Sequence[str], options: Sequence[str] = ()) -> dict[str, PolicySpec]:
    """Return policies named on the command line.

    Args:
        words: ``CONDITION[.R]=SPEC``.
        options: ``CONDITION[.R].KEY=VALUE``.

    Raises:
        ConfigError: When a word has another form, or an option is for a policy that is not named.
    """
    found = {}
    for word in words:
        name, equals, spec = word.partition("=")
        if not equals or not spec:
            raise ConfigError(f"--policy {word}: expected CONDITION[.R]=SPEC, e.g. leave_out.0=client.py:Mine")
        found[name] = PolicySpec(spec=spec)
    given: dict[str, list[str]] = {}
    for word in options:
        name = next((n for n in sorted(found, key=len, reverse=True) if word.startswith(f"{n}.")), "")
        if not name:
            raise ConfigError(f"--option {word}: it is for none of the policies; {one_of(found, word)}")
        given.setdefault(name, []).append(word[len(name) + 1 :])
    return {name: replace(policy, options=parse_options(given.get(name, []))) for name, policy in found.items()}


def require_known(design: Design, given: Iterable[str]) -> None:
    """Check for which conditions and replicates policies are named.

    Raises:
        ConfigError: When there is no such condition or replicate.
    """
    conditions, count = design.config.conditions, design.config.replicates.count
    known = [*conditions, *(f"{name}.{number}" for name in conditions for number in range(count))]
    for name in given:
        if name not in known:
            raise ConfigError(f"--policy {name}: there is no such condition or replicate; {one_of(known, name)}")


def require_found(policies: Iterable[PolicySpec | None]) -> None:
    """Check policies that are named by the user before anything runs.

    Those of checkpoints that do not exist yet are checked when they are evaluated.

    Raises:
        ConfigError: When one is unknown or does not take its options.
    """
    checked: list[PolicySpec] = []
    for policy in policies:
        if policy is not None and policy not in checked and "checkpoint" not in policy.options:
            find_policies([policy])
            checked.append(policy)


def require_trainers_policy(trainer: TrainerConfig) -> None:
    """Check the policy that is to run a trainer's checkpoints, before anything is trained.

    Raises:
        ConfigError: When it is unknown or does not take the trainer's options.
        PolicyError: When its module raises.
    """
    if trainer.command and trainer.policy not in ("", EXPERT):
        require_arguments(trainer.policy, find_policy(trainer.policy), trainer.options or {"checkpoint": ""})
