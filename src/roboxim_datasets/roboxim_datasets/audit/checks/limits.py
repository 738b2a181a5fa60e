"""What a real robot could not, or should not, have done."""

from __future__ import annotations

from collections.abc import Iterator

from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.values import AuditEpisode, Finding

FORCE_N = 5.0


@AUDIT_CHECKS.register("collision")
class Collision(AuditCheck):
    """Contacts of the robot with the table or with other objects."""

    title = "The robot hits something"
    reason = "A policy that imitates collisions damages a real robot and its surroundings."
    threshold = (
        f"a normal force above {FORCE_N:g} N between the robot and the table or an object that is not the task's"
    )
    needs = "ground truth: the recorded contacts"
    order = 19

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find collisions."""
        hits = [touch for touch in episode.require_truth().touches if touch.force_n > FORCE_N]
        if hits:
            worst = max(hits, key=lambda touch: touch.force_n)
            yield episode.finding(
                f"{worst.bodies} touch with {worst.force_n:.0f} N at tick {worst.tick}; in "
                f"{len({touch.tick for touch in hits})} ticks in all",
                ticks=(worst.tick,),
            )
