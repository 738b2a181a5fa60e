"""Import of the native kernel, with a check of its version.

The planner has no other way to check collisions. A missing or outdated kernel is an error; there is no slow fallback.
"""

from __future__ import annotations

try:
    import roboxim_planner_native as native
except ImportError as error:
    raise ImportError(f"the planner's native kernel cannot be loaded ({error}); run `make setup`") from error

EXPECTED_API = 5
if native.API != EXPECTED_API:
    raise ImportError(
        f"the planner needs version {EXPECTED_API} of its native kernel, found {native.API}; run `make setup`"
    )

__all__ = ["native"]
