"""What an evaluation records of a remote policy's server, and how it recognises the model when it continues.

A server is queried before the first worker starts. A missing server, a convention that does not fit its metadata, and a
model other than that of the folder's results are refused at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from roboxim_core.config import to_plain
from roboxim_core.errors import ConfigError, counted
from roboxim_core.plain_data.results_log import RUN_FILE
from roboxim_policies.base import load_policy
from roboxim_policies.remote import Probe, RemotePolicy, changed_facts, probe_from_plain
from roboxim_runs.policies.specs import ChosenPolicy
from roboxim_runs.storage.folder import RunFolder


@dataclass(frozen=True, kw_only=True)
class ServerRecord:
    """What ``run.json`` holds of a remote policy."""

    facts: Mapping[str, Any]
    """Wire, convention and metadata."""
    probe: Probe
    """The model's replies to a fixed request when the run began."""
    notices: tuple[str, ...] = ()
    """What the user should know of the replies; not recorded."""

    @property
    def plain(self) -> dict[str, Any]:
        """The record as plain data: keys of a run's configuration."""
        return {"server": dict(self.facts), "server_probe": to_plain(self.probe)}


def server_record(policy: ChosenPolicy, folder: RunFolder, episodes: int, timeout_s: float) -> ServerRecord:
    """Ask a remote policy's server what it is, and compare it with what a folder's results come from.

    A folder that has all episodes is not compared: its server may be gone.

    Args:
        policy: The policy.
        folder: Folder of its run.
        episodes: Number of episodes of the run.
        timeout_s: Longest wait of the evaluator for an answer [s].

    Raises:
        ConfigError: When the server is another one than the folder's, or the policy's deadline is longer than the
            evaluator's.
        PolicyError: When the server cannot be reached, or does not fit the convention.
    """
    stored = _stored(folder)
    if stored and len(folder.results()) >= episodes:
        return stored
    made = load_policy(policy.spec, **policy.options)
    assert isinstance(made, RemotePolicy)
    with made:
        if made.wire.timeout_s >= timeout_s:
            raise ConfigError(
                f"policy '{policy.name}' waits {made.wire.timeout_s:g} s for its server, the evaluator only "
                f"{timeout_s:g} s for the policy; set --option timeout_s below --policy-timeout, so that a late server "
                "is named"
            )
        now = ServerRecord(facts=made.facts(), probe=made.probe(), notices=made.notices())
    if stored is None:
        return now
    found = changed_facts(stored.facts, now.facts) or stored.probe.complaint(now.probe)
    if found and folder.results():
        raise ConfigError(
            f"{folder.path} holds {counted(len(folder.results()), 'episode')} of another model of policy "
            f"'{policy.name}': {found}; choose another output folder (--out or out=), or serve the first model again"
        )
    return now if found else replace(stored, notices=now.notices)


def _stored(folder: RunFolder) -> ServerRecord | None:
    if not folder.path.exists() or not (folder.path / RUN_FILE).exists():
        return None
    config = folder.config()
    if "server" not in config or "server_probe" not in config:
        return None
    return ServerRecord(facts=config["server"], probe=probe_from_plain(config["server_probe"]))
