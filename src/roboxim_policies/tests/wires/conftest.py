"""Makes the fake servers of this folder importable, and wires to them."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def made():
    """Make a wire, and check at the end that closing it leaves neither threads nor files."""
    from one_request import GENEROUS_S

    from roboxim_policies.wires import find_wire

    wires = []

    def make(name, url, **options):
        options = {"timeout_s": GENEROUS_S, "reconnect_s": GENEROUS_S, **options}
        wires.append(find_wire(name)(url, **options))
        return wires[-1]

    yield make
    for wire in wires:
        wire.close()
        assert not wire._is_open
