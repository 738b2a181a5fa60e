"""Whether the images show the objects of the instruction, and show which is which."""

from __future__ import annotations

from collections.abc import Iterator

from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.values import AuditEpisode, CannotCheckError, Finding, Severity

SHARE = 0.3
PIXELS = 50.0
HIDDEN_SHARE = 0.3
SAME_COLOR = 10.0
SIMILAR_COLOR = 15.0
NO_RENDERER = "the audit was made without a renderer"


@AUDIT_CHECKS.register("hidden_object")
class HiddenObject(AuditCheck):
    """An object of the instruction that the cameras do not see (thesis 6.1.2, issue 3)."""

    title = "An object of the instruction is not visible"
    reason = "The action depends on something that the policy cannot see: it must guess."
    threshold = (
        f"at the start, in a fixed camera, less than {100 * SHARE:.0f} % of the object's silhouette or fewer than "
        f"{PIXELS:g} pixels (of 256); or, before the first touch, so in every camera for more than "
        f"{100 * HIDDEN_SHARE:.0f} % of the ticks"
    )
    needs = "ground truth: a renderer of the recorded states"
    order = 3

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find hidden objects."""
        sightings = episode.require_truth().sightings
        if sightings is None:
            raise CannotCheckError(NO_RENDERER)
        if not sightings:
            raise CannotCheckError("the scene has no camera, or the instruction names no object")
        hidden = [sighting for sighting in sightings if sighting.share < SHARE or sighting.pixels < PIXELS]
        for sighting in hidden:
            if sighting.tick == 0 and sighting.fixed:
                yield episode.finding(
                    f"{sighting.camera} sees {100 * sighting.share:.0f} % of the {sighting.thing} at the start "
                    f"({sighting.pixels:.0f} pixels)",
                    ticks=(0,),
                    cameras=(sighting.camera,),
                )
        seen = {(s.thing, s.tick) for s in sightings if s not in hidden}
        for thing in sorted({sighting.thing for sighting in sightings}):
            ticks = sorted({sighting.tick for sighting in sightings if sighting.thing == thing})
            lost = [tick for tick in ticks if (thing, tick) not in seen]
            if len(lost) > HIDDEN_SHARE * len(ticks):
                yield episode.finding(
                    f"no camera sees the {thing} in {len(lost)} of {len(ticks)} ticks before the first touch",
                    ticks=(lost[0], lost[-1]) if len(lost) > 1 else (lost[0],),
                )


@AUDIT_CHECKS.register("indistinguishable")
class Indistinguishable(AuditCheck):
    """Objects that only their colour distinguishes, and it does not (thesis 6.1.2, issue 5)."""

    title = "Objects cannot be distinguished"
    reason = "The image does not say which object the instruction means; the policy learns to pick either."
    threshold = (
        "nine tenths of the pixels of a named object, and of another one of the same noun and size, have a counterpart "
        f"in the other within a colour difference (CIEDE2000) of {SAME_COLOR:g}; within {SIMILAR_COLOR:g} a warning"
    )
    needs = "ground truth: the recorded image, masked by a renderer"
    order = 5

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find objects of one colour."""
        pairs = episode.require_truth().pairs
        if pairs is None:
            raise CannotCheckError(NO_RENDERER)
        for pair in pairs:
            if pair.difference < SIMILAR_COLOR:
                yield episode.finding(
                    f"{pair.camera}: the {pair.named} and the {pair.other} differ by {pair.difference:.1f}",
                    ticks=(0,),
                    cameras=(pair.camera,),
                    severity=Severity.FAULT if pair.difference < SAME_COLOR else Severity.WARNING,
                )
