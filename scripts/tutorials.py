"""Run the tutorials in `docs/tutorials` as a reader would, block by block, and compare what they print.

    python scripts/tutorials.py docs/tutorials/own_task.md           # fails at the first block that fails
    python scripts/tutorials.py docs/tutorials/own_task.md --write   # the same, and writes the outputs into the page

A page's blocks run in their order, in one folder that is empty at the start:

- ``python title="my_policy.py"`` (any language with a title) is a file, which is written;
- ``bash`` is run by bash, which stops at the first command that fails. Variables stay for later blocks. What runs in
  the background is ended after the last block;
- ``python`` is a program, run by itself;
- ``text`` is what the block above printed. A line ``...`` stands for any lines. Durations may differ, and after
  ``text varies`` every number. Lines that say what begins (``drawing ...``) are left out.

``<!-- from runs/scene.png -->`` behind a picture names the file that the page makes it from: it must be there at the
end, and ``--write`` copies it.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "tutorials"
FENCE = re.compile(r"^```([^\n`]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
TITLE = re.compile(r'\w+ title="([^"]+)"')
PICTURE = re.compile(r"!\[[^\]]*\]\(([^)]+)\)\s*<!-- from (\S+) -->")
NUMBER = r"-?\d[\d,]*(?:\.\d+)?"
BEGINS = re.compile(r"^[a-z][a-z -]* \.\.\.\n", re.MULTILINE)
DURATION = re.compile(rf"{NUMBER} ?(?:ms|s|min|h)\b|{NUMBER}/min")
WIDTH_PX = 1200
"""Largest width of a picture that is copied."""


class TutorialError(Exception):
    """A block failed, or printed something else than the page says."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    line: int
    language: str
    """Info string after the fence."""
    text: str
    start: int
    """Where its text begins in the page."""

    def __str__(self) -> str:
        """Name it."""
        return f"{self.page}:{self.line}"


def blocks(page: Path) -> list[Block]:
    """Return the blocks of a page, in their order."""
    text = page.read_text()
    return [
        Block(page.name, text.count("\n", 0, found.start()) + 1, found[1].strip(), found[2], found.start(2))
        for found in FENCE.finditer(text)
    ]


def pattern(shown: str, varies: bool = False) -> re.Pattern[str]:
    """Return what an output must match.

    Args:
        shown: The output on the page.
        varies: Whether all numbers may differ, rather than durations alone.
    """
    free = re.compile(NUMBER) if varies else DURATION
    lines = []
    for line in shown.splitlines():
        if line == "...":
            lines.append(r"(?:.*\n)*?")
        else:
            kept = (re.escape(part) for part in free.split(line.rstrip()))
            lines.append(f"(?:{free.pattern})".join(kept) + r"[ ]*\n")
    return re.compile("".join(lines))


class Session:
    """A reader's terminal, in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._state = folder.parent / f"{folder.name}.state"  # beside the folder, where no command looks
        self._state.mkdir()
        self._groups: list[int] = []

    def run(self, block: Block) -> str:
        """Run a block; return what it printed.

        Raises:
            TutorialError: It failed.
        """
        if title := TITLE.fullmatch(block.language):
            file = self.folder / title[1]
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(block.text)
            return ""
        kept, program, printed = self._state / "variables", self._state / "program", self._state / "printed"
        program.write_text(block.text)
        own = f"{sys.executable} {program}" if block.language == "python" else block.text
        kept.touch()
        script = f"source {kept}\n{own}\nexport -p > {kept}\n"
        with printed.open("w") as output:
            process = subprocess.Popen(
                ["bash", "-euo", "pipefail", "-c", script],
                cwd=self.folder, env=self._environment(), stdin=subprocess.DEVNULL, stdout=output,
                stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
            self._groups.append(process.pid)
            process.wait()
        text = BEGINS.sub("", printed.read_text())
        if process.returncode != 0:
            raise TutorialError(f"{block} failed with exit code {process.returncode}:\n{block.text}\n{text[-3000:]}")
        return text

    def _environment(self) -> dict[str, str]:
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("ROBOXIM_CONFIG", "PYTEST"))}
        return kept | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}

    def close(self) -> None:
        """End what runs in the background."""
        for group in self._groups:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(group, signal.SIGTERM)
        shutil.rmtree(self._state)


def run_page(page: Path, folder: Path, *, write: bool = False) -> None:
    """Run a page's blocks, and compare or write what they print.

    Args:
        page: The tutorial.
        folder: An empty folder.
        write: Write the outputs and pictures into the documentation instead of comparing them.

    Raises:
        TutorialError: A block failed, or printed something else.
    """
    session = Session(folder)
    replaced: list[tuple[Block, str]] = []
    try:
        printed = ""
        for block in blocks(page):
            if block.language not in ("text", "text varies"):
                printed = session.run(block)
            elif write:
                replaced.append((block, shortened(printed, block.text)))
            elif not pattern(block.text, "varies" in block.language).fullmatch(printed):
                raise TutorialError(f"{block} shows\n{block.text}\nbut the block above it printed\n{printed}")
        for picture, source in PICTURE.findall(page.read_text()):
            if not (folder / source).is_file():
                raise TutorialError(f"{page.name} did not make {source}")
            if write:
                copy_picture(folder / source, page.parent / picture)
    finally:
        session.close()
    text = page.read_text()
    for block, new in reversed(replaced):
        text = text[: block.start] + new + text[block.start + len(block.text) :]
    page.write_text(text) if write else None


def shortened(printed: str, shown: str) -> str:
    """Return an output for a page: what the page left out by ``...`` stays out, if what it shows can be found.

    Args:
        printed: The output.
        shown: What the page shows until now; ``...`` alone: nothing, so that all is written.
    """
    plain = re.sub(r"[ \t]+$", "", printed, flags=re.MULTILINE)
    if shown == "...\n" or not re.search(r"^\.\.\.$", shown, re.MULTILINE):
        return plain
    anywhere = pattern(shown, varies=True)
    found = re.fullmatch(anywhere.pattern.replace(r"(?:.*\n)*?", r"((?:.*\n)*?)"), plain)
    if found is None:
        return plain
    for number in range(len(found.groups()), 0, -1):
        plain = plain[: found.start(number)] + "...\n" + plain[found.end(number) :]
    return plain


def copy_picture(source: Path, target: Path) -> None:
    """Copy a picture or a film into the documentation, in the format of its name, not wider than `WIDTH_PX`."""
    from PIL import Image

    target.parent.mkdir(parents=True, exist_ok=True)
    with Image.open(source) as picture:
        if getattr(picture, "is_animated", False):
            shutil.copy(source, target)
            return
        picture.thumbnail((WIDTH_PX, WIDTH_PX))
        picture.convert("RGB").save(target, quality=80)


def main() -> int:
    """Run pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="+", type=Path, metavar="PAGE")
    parser.add_argument("--write", action="store_true", help="write outputs and pictures into the documentation")
    parser.add_argument("--keep", type=Path, help="folder to work in, which stays; default: a temporary one")
    options = parser.parse_args()
    for page in options.pages:
        with tempfile.TemporaryDirectory() as temporary:
            folder = (options.keep or Path(temporary)) / page.stem
            folder.mkdir(parents=True)
            try:
                run_page(page.resolve(), folder.resolve(), write=options.write)
            except TutorialError as error:
                print(error, file=sys.stderr)
                return 1
            print(f"{page}: every block ran")
    return 0


if __name__ == "__main__":
    sys.exit(main())
