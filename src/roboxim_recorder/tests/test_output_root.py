from __future__ import annotations

import pytest

from roboxim_core.errors import InvalidRequestError
from roboxim_recorder.output_root import require_inside


def test_folders_below_the_root_are_taken(tmp_path):
    root = tmp_path / "run"
    for inside in (root, root / "a" / "b", root / "a" / ".." / "c"):
        assert require_inside(str(inside), root) == inside.resolve()


@pytest.mark.parametrize("leaving", ["/etc", "/", "{root}/../other", "{root}-evil", "{root}/a/../../..", "~root"])
def test_folders_outside_of_the_root_are_refused(tmp_path, leaving):
    root = tmp_path / "run"
    with pytest.raises(InvalidRequestError, match="outside of|absolute"):
        require_inside(leaving.format(root=root), root)


@pytest.mark.parametrize("link", ["out", "out/.partial", "out/episodes", "out/set_apart"])
def test_links_out_of_the_root_are_refused(tmp_path, link):
    root, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (root / link).parent.mkdir(parents=True)
    (root / link).symlink_to(elsewhere)
    with pytest.raises(InvalidRequestError, match="outside of"):
        require_inside(str(root / "out"), root)


@pytest.mark.parametrize("bad", ["relative", "", "/tmp/\0", "/" + "x" * 5000])
def test_what_is_no_folder_is_refused(tmp_path, bad):
    with pytest.raises(InvalidRequestError):
        require_inside(bad, tmp_path)
