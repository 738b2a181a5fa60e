"""RoboXim's benchmarks, in folders by subject; `make bench-NAME` runs one."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))  # planted results
