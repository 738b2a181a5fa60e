"""Checks of datasets, by name: one class per check, one file per family.

A check examines the episodes one after another, and may then report findings about all of them. Another distribution
adds one through the entry point group ``roboxim.audit_check``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from roboxim_core.registry import Registry
from roboxim_datasets.audit.values import AuditEpisode, Finding


class AuditCheck:
    """A check. Each audit creates a new instance, which may keep state."""

    title: ClassVar[str] = ""
    """The fault that it finds, as a short noun phrase."""
    reason: ClassVar[str] = ""
    """Why a trainer cares, in one sentence."""
    threshold: ClassVar[str] = ""
    """What counts as a finding, with numbers."""
    needs: ClassVar[str] = "any dataset"
    """What the check needs, for the table of checks."""
    takes_any_number: ClassVar[bool] = False
    """Whether it looks at episodes with numbers that are not finite; of the others it is not made."""
    order: ClassVar[int] = 100
    """Place in reports; equal ones are sorted by name."""

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Yield what is wrong with an episode.

        Raises:
            CannotCheckError: When the episode lacks what the check needs.
        """
        yield from ()

    def conclude(self) -> Iterator[Finding]:
        """Yield what is wrong with the dataset, after the last episode."""
        yield from ()


AUDIT_CHECKS: Registry[type[AuditCheck]] = Registry("audit check")
"""Classes of checks by name; they take no arguments."""


@AUDIT_CHECKS.conformance
def says_what_it_is(name: str, item: type[AuditCheck]) -> None:
    """Refuse a check that a report could not explain."""
    assert issubclass(item, AuditCheck), "it does not derive from AuditCheck"
    for field in ("title", "reason", "threshold", "needs"):
        assert getattr(item, field).strip(), f"it has no {field}, which reports show"
    overridden = item.look is not AuditCheck.look or item.conclude is not AuditCheck.conclude
    assert overridden, "it has neither look nor conclude"


@AUDIT_CHECKS.conformance
def finds_nothing_in_nothing(name: str, item: type[AuditCheck]) -> None:
    """Refuse a check that finds something in a dataset without episodes."""
    assert not list(item().conclude()), "it finds something in a dataset without episodes"
