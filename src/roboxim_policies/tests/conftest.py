"""Makes the made-up demonstrations of this folder importable, and a policy that has learnt them."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """Return the folder of a training, and its reports."""
    from made_up_demonstrations import CONFIG, data

    from roboxim_policies.learning.train import Trainer

    folder = tmp_path_factory.mktemp("bc")
    reports = []
    Trainer(data(), CONFIG, folder).run(reports.append)
    return folder, reports
