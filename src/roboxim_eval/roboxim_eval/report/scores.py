"""The scores of an experiment's card: names, values, meanings, and the episodes behind them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.card_checks import design_of_card
from roboxim_eval.experiments.cells import chosen
from roboxim_eval.report.episodes import Link, any_of, no_link

SCORES = {
    "absolute": ("absolute, u", "success in held-out cells", "success of the leave-out condition in held-out cells; "
                 "it ranks models"),
    "baseline": ("baseline, s", "success of the baseline there", "success of the baseline in the same cells"),
    "gap": ("gap, s - u", "success lost by holding out", "success lost by holding out; the primary test"),
    "relative": ("relative, u / s", "remaining share of the baseline's success", "the remaining share of the "
                 "baseline's success"),
    "words": ("words, u - b", "effect of the instruction", "success lost without an instruction; if it is small, the "
              "scene suffices"),
    "competence": ("competence", "difference where both have trained", "leave-out minus baseline in cells that both "
                   "have seen; far from 0, the gap is not due to the held-out cells alone"),
    "substitution": ("substitution", "failures that satisfied another taught instruction", "share of failed held-out "
                     "episodes that satisfied another instruction of the training; 0 has no meaning where no scene "
                     "allows one"),
}  # fmt: skip
"""Score of a card to its name in tables, its description, and its meaning."""
WITHOUT_BASELINE = {
    "absolute": ("success in held-out cells", "success of {first} in held-out cells; it ranks models"),
    "baseline": ("success of {second} there", "success of {second} in the same cells, not trained in them either"),
    "gap": ("{second} minus {first} there", "difference in held-out cells; not what holding out costs, since neither "
            "was trained in them; the primary test"),
    "relative": ("ratio of {first} to {second}", "success of {first} as a share of that of {second}"),
    "competence": ("{first} minus {second} where both have trained", "difference in cells that both have seen"),
}  # fmt: skip
"""The same without a baseline: the second condition was not trained in held-out cells either."""
POINTS = ("gap", "words", "competence")
"""Scores that are differences, shown in points."""


def score_rows(card: Card, link: Link = no_link) -> Iterator[dict[str, str]]:
    """Yield names, value, interval, meaning and link of each score; for a refused or unmeasured one, the reason.

    Args:
        card: The card.
        link: Makes the links.
    """
    found = card.scores or {}
    behind = behind_scores(card) if found else {}
    without = card.experiment.config.primary if found and not has_baseline(card) else None
    for key, (name, plain, meaning) in SCORES.items():
        if key not in found:
            continue
        if without and key in WITHOUT_BASELINE:
            plain, meaning = (text.format(first=without.first, second=without.second) for text in WITHOUT_BASELINE[key])
        value = found[key]
        shown, interval = "-", "not measured"
        if key == "relative" and value is None:
            shown, interval = "refused", found["relative_refused"]
        elif key == "substitution" and value is not None:
            if value["failed"]:
                shown, interval = _score(value["rate"], points=False)
                if not value["rate"][0]:  # known from the task files, which a card does not hold
                    interval += ", if scenes allow another instruction"
            else:
                interval = "no held-out episode failed"
        elif value is not None:
            shown, interval = _score(value, points=key in POINTS)
        to = "" if shown == "-" else link(**behind[key])
        yield {"name": name, "plain": plain, "value": shown, "interval": interval, "meaning": meaning, "link": to}


def has_baseline(card: Card) -> bool:
    """Return whether the primary comparison's second condition was trained in held-out cells, or with unknown data."""
    design = design_of_card(card)
    primary, conditions = design.config.primary, design.config.conditions
    if primary is None:
        return False
    trained = conditions[conditions[primary.second].checkpoint_of or primary.second].train
    counts = design.datasets.get(trained)
    return counts is None or any(cell.unseen and counts.get(cell.key) for cell in design.cells)


def no_baseline_line(card: Card) -> str:
    """Return what the scores of a card without a baseline are not; empty: it has one, or no scores."""
    primary = card.experiment.config.primary
    if not card.scores or primary is None or has_baseline(card):
        return ""
    return (
        f"{primary.second} was not trained in held-out cells either: 'baseline' is its success there, and 'gap' not "
        "what holding out costs."
    )


def behind_scores(card: Card) -> dict[str, dict[str, str]]:
    """Return the properties of the episodes behind each score of a card."""
    config, cells = card.experiment.config, design_of_card(card).cells
    primary = config.primary
    assert primary is not None, "a card has no scores otherwise"
    both, blind = any_of((primary.first, primary.second)), any_of((primary.first, config.blind))
    unseen, seen = (any_of(cell.key for cell in chosen(cells, where)) for where in ("unseen", "seen"))
    return {
        "absolute": {"arm": primary.first, "cell": unseen},
        "baseline": {"arm": primary.second, "cell": unseen},
        "gap": {"arm": both, "cell": unseen},
        "relative": {"arm": both, "cell": unseen},
        "words": {"arm": blind, "cell": unseen},
        "competence": {"arm": both, "cell": seen},
        "substitution": {"arm": primary.first, "cell": unseen, "outcome": "failure"},
    }


def _score(value: Sequence[float | None], *, points: bool) -> tuple[str, str]:
    middle, low, high = value
    if low is None and high is None:
        return f"{round(100 * (middle or 0)) + 0:+d} points" if points else f"{middle:.2f}", "none from one training"
    if points:
        shown = ["unbounded" if x is None else f"{round(100 * x) + 0:+d}" for x in (low, high)]
        return f"{round(100 * (middle or 0)) + 0:+d} points", f"{shown[0]} to {shown[1]}"
    shown = ["unbounded" if x is None else f"{x:.2f}" for x in (low, high)]
    return "unbounded" if middle is None else f"{middle:.2f}", f"{shown[0]} to {shown[1]}"


def substitutions(card: Card, link: Link) -> list[tuple[str, str, int, int, str]]:
    """Return held-out cell, the instruction satisfied instead, number of failures, link; most frequent first."""
    judged, primary = card.judged_again or (), card.experiment.config.primary
    failed = Counter(row.cell for row in judged)
    found = Counter((row.cell, sorted(row.satisfied)[0]) for row in judged if row.satisfied)
    arm = primary.first if primary else ""
    return [
        (cell, instead, count, failed[cell], link(arm=arm, cell=cell, outcome="failure"))
        for (cell, instead), count in found.most_common(12)
    ]
