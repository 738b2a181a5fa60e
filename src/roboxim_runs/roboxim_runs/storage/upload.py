"""Uploads the small files of a run to its store, which belongs to that run alone."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from roboxim_core.errors import ConfigError, counted
from roboxim_core.plain_data.differences import differences
from roboxim_core.plain_data.documents import read_json_object
from roboxim_core.plain_data.results_log import RUN_FILE
from roboxim_runs.storage.folder import MAY_DIFFER, run_key
from roboxim_runs.storage.store import SHARDS, SMALL_FILES, STORED_FILE, Store, stored_bags

"""Folder of a store with a folder ``I-of-N`` for each shard's small files."""
UPLOAD_PERIOD_S = 60.0
"""Time between two uploads of a run's small files [s]."""


class RunUpload:
    """Uploads the small files of a run from time to time."""

    def __init__(self, run: Path, url: str, *, shard: str = "") -> None:
        """Store the folder and the URL.

        Args:
            run: The run's folder.
            url: The run's store; empty: none.
            shard: ``I/N``: a shard's files go to ``shards/I-of-N`` in the store, those of a whole run to its root.
        """
        self._run, self._url, self._last = run, url, time.monotonic()
        self._prefix = f"{SHARDS}/{shard.replace('/', '-of-')}/" if shard else ""

    def require_own(self, config: Mapping[str, Any], *, repair: bool = False) -> None:
        """Refuse a store that has bags of another run, or bags of this run that the folder does not know.

        Args:
            config: Configuration of the run.
            repair: Accept bags that the folder does not know; their episodes are run again.

        Raises:
            ConfigError: Saying what the store has.
            UnavailableError: When the store cannot be reached.
        """
        if not self._url:
            return
        with Store.opened(self._url) as store, tempfile.TemporaryDirectory(prefix="roboxim-store-") as place:
            shards = [f"{SHARDS}/{name}/" for name in store.folders(SHARDS)[:1]]  # any: all are of one run
            for prefix in dict.fromkeys(["", self._prefix, *shards]):
                if store.has(prefix + RUN_FILE):
                    store.get(prefix + RUN_FILE, Path(place) / RUN_FILE)
                    self._require_same(read_json_object(Path(place) / RUN_FILE), config)
            if not repair and store.has(self._prefix + STORED_FILE):
                store.get(self._prefix + STORED_FILE, Path(place) / STORED_FILE)
                self._require_known(len(stored_bags(Path(place)).keys() - stored_bags(self._run).keys()))

    def _require_same(self, theirs: Mapping[str, Any], config: Mapping[str, Any]) -> None:
        if run_key(theirs) != run_key(config):
            details = differences(theirs, json.loads(json.dumps(dict(config))), ignore=MAY_DIFFER)
            raise ConfigError(
                f"the store {self._url} holds another run ({details}), whose bags this one would replace; choose "
                "another --store or store="
            )

    def _require_known(self, lost: int) -> None:
        if lost:
            raise ConfigError(
                f"the store {self._url} holds {counted(lost, 'bag')} of this run that {self._run} does not "
                f"know: another folder runs it, or this one is new; copy {', '.join(SMALL_FILES)} from "
                f"{self._url}/{self._prefix} into the folder to continue, choose another --store or store=, or run "
                "these episodes again with --repair or repair=True"
            )

    def now_and_then(self) -> None:
        """Upload them if the last upload was long ago."""
        if self._url and time.monotonic() - self._last > UPLOAD_PERIOD_S:
            self.all()

    def all(self) -> None:
        """Upload them."""
        if not self._url:
            return
        with Store.opened(self._url) as store:
            for name in SMALL_FILES:
                if (self._run / name).exists():
                    store.put(self._run / name, self._prefix + name)
        self._last = time.monotonic()
