"""The policies of an experiment's evaluations: trained here, trained elsewhere, or evaluated in another way."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from roboxim_bringup.parameters import parse_options
from roboxim_bringup.runs.policies import EXPERT, PolicySpec, find_policies
from roboxim_core.errors import ConfigError, one_of
from roboxim_eval.experiments import Design, Stage


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
    name, replicate = stage.name.removeprefix("evaluate/").rsplit(".", 1)
    replicate, _, step = replicate.partition("@")
    condition = design.config.conditions[name]
    for key in () if step else (f"{name}.{replicate}", name):
        if key in given:
            return replace(given[key], name=name)
    base = condition.checkpoint_of or name
    for key in (f"{base}.{replicate}", base):
        if key in given:
            return _worded(given[key], name, condition.instruction)
    if not design.trainer.command or design.config.conditions[base].given:
        return None
    at = f"@{step}" if step else ""
    checkpoint = str((out / f"train/{base}.{replicate}{at}").resolve())
    policy = PolicySpec(spec=design.trainer.policy, options={"checkpoint": checkpoint})
    return _worded(policy, name, condition.instruction)


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

    Raises:
        ConfigError: When one is unknown or does not take its options.
    """
    checked: list[PolicySpec] = []
    for policy in policies:
        if policy is not None and policy not in checked and "checkpoint" not in policy.options:
            find_policies([policy])
            checked.append(policy)
