"""The tutorials run from their first block to their last, and print what they show."""

from __future__ import annotations

import re
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

from tutorials import FOLDER, Session, TutorialError, blocks, pattern, run_page, shortened  # noqa: E402

PAGES = sorted(FOLDER.glob("*.md"))
MAX_LINES = 120


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_block_runs(page: Path, tmp_path: Path) -> None:
    (tmp_path / "reader").mkdir()
    run_page(page, tmp_path / "reader")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_tutorial_has_its_parts(page: Path) -> None:
    text = page.read_text()
    assert len(text.splitlines()) <= MAX_LINES
    assert "At the end you have" in text
    assert re.search(r"takes? about \d+ minutes|\d+\s+minutes", text)
    assert "## Next steps" in text
    assert {block.language.split()[0] for block in blocks(page)} >= {"bash"} or "```python" in text
    assert any(block.language.startswith("text") for block in blocks(page)), "it shows no output"


def page_of(tmp_path: Path, text: str) -> tuple[Path, Path]:
    (tmp_path / "reader").mkdir()
    page = tmp_path / "page.md"
    page.write_text(text)
    return page, tmp_path / "reader"


def test_files_variables_and_outputs(tmp_path: Path) -> None:
    text = (
        '```python title="a/b.py"\nprint(7)\n```\n```bash\nexport WORD=hello\n```\n'
        "```bash\necho $WORD\npython a/b.py\n```\n```text\nhello\n7\n```\n```python\nprint('took 3 s')\n```\n"
        "```text\ntook 99.5 s\n```\n```bash\necho 'drawing objects ...' >&2; echo done\n```\n```text\ndone\n```\n"
    )
    page, folder = page_of(tmp_path, text)
    run_page(page, folder)
    run_page_again = page.read_text()
    assert run_page_again == text


@pytest.mark.parametrize(
    "block",
    ["bash\nfalse\n", "bash\nfalse | true\n", "bash\nexit 3\n", "python\nraise SystemExit(1)\n", "bash\n$UNSET\n"],
)
def test_a_block_that_fails_fails(block: str, tmp_path: Path) -> None:
    page, folder = page_of(tmp_path, f"```{block}```\n")
    with pytest.raises(TutorialError, match="failed with exit code"):
        run_page(page, folder)


def test_another_output_fails_and_is_written(tmp_path: Path) -> None:
    page, folder = page_of(tmp_path, "```bash\nseq 5\n```\n```text\n1\n...\n6\n```\n")
    with pytest.raises(TutorialError, match="shows"):
        run_page(page, folder)
    run_page(page, folder, write=True)
    assert "1\n...\n5\n" in page.read_text()
    run_page(page, folder)


def test_a_picture_must_have_been_made(tmp_path: Path) -> None:
    page, folder = page_of(tmp_path, "```bash\ntrue\n```\n![p](p.png) <!-- from q.png -->\n")
    with pytest.raises(TutorialError, match="did not make q.png"):
        run_page(page, folder)


def test_what_runs_in_the_background_is_ended(tmp_path: Path) -> None:
    page, folder = page_of(tmp_path, "```bash\nsleep 1000 &\necho $!\n```\n")
    session = Session(folder)
    number = int(session.run(blocks(page)[0]))
    session.close()
    for _ in range(100):
        state = Path(f"/proc/{number}/stat")
        if not state.exists() or state.read_text().split()[2] == "Z":
            return
        time.sleep(0.05)
    raise AssertionError("it runs on")


def test_patterns() -> None:
    assert pattern("4 of 4 after 36 s; 6.8/min\n").fullmatch("4 of 4 after 2 min; 7/min\n")
    assert not pattern("4 of 4 after 36 s\n").fullmatch("3 of 4 after 36 s\n")
    assert pattern("3 of 4 = 75 %\n", varies=True).fullmatch("1 of 4 = 25 %\n")
    assert shortened("a\n1 x\nb 2\n", "a\n...\nb 1\n") == "a\n...\nb 2\n"
