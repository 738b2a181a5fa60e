"""Configuration of the family act."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from roboxim_policies.learning.encoded_config import EncodedConfig


@dataclass(frozen=True, kw_only=True)
class ACTConfig(EncodedConfig):
    """Network and training of ``act``. Time is counted in steps, never in seconds."""

    FAMILY: ClassVar[str] = "act"

    chunk: int = 16
    """Actions predicted per observation."""
    execute: int = 4
    """Actions executed per observation, 1..``chunk``."""
