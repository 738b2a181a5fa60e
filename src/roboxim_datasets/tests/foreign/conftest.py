"""Makes the made-up datasets of `made_foreign` importable in the tests of this folder."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
