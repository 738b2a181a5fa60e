"""The audit: a fold of the registered checks over a dataset's episodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from roboxim_core.errors import InvalidRequestError, RecorderError
from roboxim_datasets.audit import checks  # noqa: F401  registers them
from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.values import (
    NOT_FINITE,
    AuditEpisode,
    AuditResult,
    CannotCheckError,
    CheckResult,
    Finding,
)


class Auditor:
    """Looks at episodes one after another; memory does not grow with their images."""

    def __init__(self, names: Iterable[str] = ()) -> None:
        """Make the checks.

        Args:
            names: Registered names; none: all.

        Raises:
            ConfigError: On an unknown name.
        """
        chosen = tuple(names) or tuple(AUDIT_CHECKS)
        made: dict[str, AuditCheck] = {name: AUDIT_CHECKS[name]() for name in chosen}
        self._checks = dict(sorted(made.items(), key=lambda item: (item[1].order, item[0])))
        self._checked: Counter[str] = Counter()
        self._unchecked: dict[str, Counter[str]] = {name: Counter() for name in made}
        self._findings: dict[str, list[Finding]] = {name: [] for name in made}
        self._unreadable: dict[str, str] = {}
        self._episodes = self._steps = 0

    def add(self, episode: AuditEpisode) -> list[tuple[str, Finding]]:
        """Look at an episode; return what was found, by check."""
        self._episodes += 1
        self._steps += len(episode.episode)
        found: list[tuple[str, Finding]] = []
        try:
            for name, check in self._checks.items():
                try:
                    if not (check.takes_any_number or episode.finite):
                        raise CannotCheckError(NOT_FINITE)
                    found += [(name, finding) for finding in check.look(episode)]
                except (CannotCheckError, InvalidRequestError) as error:
                    self._unchecked[name][str(error)] += 1
                else:
                    self._checked[name] += 1
        except RecorderError as error:
            self.add_unreadable(episode.name, str(error))
        for name, finding in found:
            self._findings[name].append(finding)
        return found

    def add_unreadable(self, name: str, why: str) -> None:
        """Note an episode that cannot be read."""
        self._unreadable[name] = why

    def note(self, check: str, findings: Iterable[Finding]) -> None:
        """Add findings about the whole dataset, such as a missing episode; of a check that is made."""
        if check in self._findings:
            self._findings[check] += findings

    def result(self) -> AuditResult:
        """Conclude the audit; call it once."""
        return AuditResult(
            episodes=self._episodes,
            steps=self._steps,
            checks=tuple(self._result(name, check) for name, check in self._checks.items()),
            unreadable=dict(self._unreadable),
        )

    def _result(self, name: str, check: AuditCheck) -> CheckResult:
        return CheckResult(
            name=name,
            title=check.title,
            reason=check.reason,
            threshold=check.threshold,
            checked=self._checked[name],
            unchecked=dict(self._unchecked[name]),
            findings=(*self._findings[name], *check.conclude()),
        )
