"""The seed of fresh scenes in a run's folder, and what the card says about them.

``OUT/scene_seed.json`` holds the seed and its nonce. It is written once, by ``experiment attest`` before the trainings
or by the first call with ``--fresh`` that is not refused, and decides the scenes of all later calls. Each training's
line in ``stages.jsonl`` states the commitment that existed when the training ended.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from roboxim_core.config import from_plain, to_plain
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.documents import read_json
from roboxim_core.whole_files import write_json
from roboxim_eval.experiments import ExperimentConfig
from roboxim_eval.experiments.card import Card, CardFresh
from roboxim_eval.experiments.card_checks import check_card
from roboxim_eval.experiments.fresh import SceneSeed, fresh_part
from roboxim_runs.storage.folder import make_folder

SEED_FILE = "scene_seed.json"
PUBLIC_FILE = "public_card.json"
"""Card of the same policies in the public scenes."""
COMMITTED = "committed"
"""Key of a training's line in ``stages.jsonl``."""


def stored_seed(out: Path) -> SceneSeed | None:
    """Return the seed of a run's fresh scenes; none: its scenes are the public ones.

    Raises:
        ConfigError: When the file is damaged.
    """
    path = out / SEED_FILE
    found: SceneSeed | None = from_plain(read_json(path), SceneSeed, source=str(path)) if path.exists() else None
    return found


def drawn_seed(out: Path) -> SceneSeed:
    """Return the seed of a run's fresh scenes, drawn by the first call."""
    seed = stored_seed(out) or SceneSeed.drawn()
    make_folder(out)
    store_seed(seed, out)
    return seed


def require_no_other_seed(seed: SceneSeed, out: Path) -> None:
    """Check that a run's folder may get a seed.

    Raises:
        ConfigError: When it has another one.
    """
    if stored_seed(out) not in (None, seed):
        raise ConfigError(f"{out} has fresh scenes of another seed; choose another output folder (--out)")


def store_seed(seed: SceneSeed, out: Path) -> None:
    """Write a seed into a run's folder, unless it is there.

    Raises:
        ConfigError: When the folder has another one.
    """
    require_no_other_seed(seed, out)
    if not (out / SEED_FILE).exists():
        write_json(out / SEED_FILE, to_plain(seed))


def in_scenes_of(config: ExperimentConfig, seed: int) -> ExperimentConfig:
    """Return an experiment whose scenes have another seed; 0: that of its file."""
    return replace(config, evaluate=replace(config.evaluate, seed=seed)) if seed else config


def card_part(out: Path, products: Mapping[str, Mapping[str, Any]], card: Card) -> CardFresh | None:
    """Return what a card says about its fresh scenes; none: they are public.

    Args:
        out: The run's folder.
        products: Stage to its line in ``stages.jsonl``.
        card: The card so far.

    Raises:
        ConfigError: When the policies in the public scenes were others.
    """
    seed = stored_seed(out)
    if seed is None:
        return None
    known = {f"train/{one.condition}.{one.replicate}" for one in card.trainings}  # the folder may have had others
    trained = [name for name in products if name in known]
    before = sum(products[name].get(COMMITTED) != seed.commitment for name in trained)
    public = _public_card(out)
    if public is not None:
        here = {(one.condition, one.replicate): one.checkpoint_sha256 for one in card.trainings}
        for one in public.trainings:
            name = f"{one.condition}.{one.replicate}"
            if one.checkpoint_sha256 != here.get((one.condition, one.replicate), one.checkpoint_sha256):
                raise ConfigError(f"{out / PUBLIC_FILE}: its policy {name} is not the one of this run")
    return fresh_part(seed, before, public)


def _public_card(out: Path) -> Card | None:
    path = out / PUBLIC_FILE
    return check_card(read_json(path), source=str(path)) if path.exists() else None
