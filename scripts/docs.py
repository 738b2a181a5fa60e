"""Check the links of every Markdown file, then build the documentation as a site into `site/`.

The check covers links to files and to headings. It does not follow links to the web. The site has the pages of `docs/`
in the order of `mkdocs.yml`, the README as its front page, the help of every command, and the reference of
all packages (`api/`). It opens and searches without a network.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / "site"
DOCS = ROOT / "docs"
RAW_RESULTS = ("*-laptop", "*-night", "conventions")
"""Folders of `docs/results` that hold data rather than pages."""
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)[^)]*\)|<img[^>]+src=\"([^\"]+)\"")
PACKAGES = sorted(path.parent.name for path in ROOT.glob("src/*/setup.py"))


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, spelled as GitHub spells them."""
    headings = re.findall(r"^#+\s+(.+?)\s*$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken_links(page: Path) -> list[str]:
    """Return the broken links of a page: those to a missing file or heading."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    broken = []
    for target in (first or second for first, second in LINK.findall(text)):
        if "://" in target or target.startswith("mailto:"):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        if not file.exists() or (anchor and file.suffix == ".md" and anchor not in anchors(file)):
            broken.append(f"{page.relative_to(ROOT)}: {target}")
    return broken


def main() -> int:
    """Check, then write."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    pages = [ROOT / name for name in listed.stdout.splitlines() if (ROOT / name).exists()]
    broken = [link for page in pages for link in broken_links(page)]
    if broken:
        print("Broken links:", *broken, sep="\n  ", file=sys.stderr)
        return 1
    print(f"The links of {len(pages)} pages are valid.")
    with tempfile.TemporaryDirectory() as folder:
        write_pages(Path(folder) / "docs")
        shutil.copy(ROOT / "mkdocs.yml", folder)
        mkdocs = ROOT / ".tools" / "docs-env" / "bin" / "mkdocs"
        subprocess.run([mkdocs, "build", "--quiet", "--strict", "--site-dir", SITE], cwd=folder, check=True)
    command = [
        sys.executable,
        "-m",
        "pdoc",
        *("--template-directory", str(ROOT / "scripts" / "pdoc")),
        "--docformat",
        "google",
        "--output-directory",
        str(SITE / "api"),
        *PACKAGES,
    ]
    result = subprocess.run(command, cwd=ROOT, check=False)
    if result.returncode == 0:
        print(f"The site is in {(SITE / 'index.html').relative_to(ROOT)}.")
    return result.returncode


def write_pages(folder: Path) -> None:
    """Write what the site is built from: the pages of `docs/`, the README and the help of all commands."""
    shutil.copytree(DOCS, folder, ignore=shutil.ignore_patterns(*RAW_RESULTS))
    shutil.copy(ROOT / "README.md", folder / "index.md")
    for page in folder.rglob("*.md"):
        source = ROOT / "README.md" if page.name == "index.md" else DOCS / page.relative_to(folder)
        page.write_text(site_links(page.read_text(), source, folder))
    (folder / "reference" / "cli.md").write_text(command_reference())
    (folder / "reference" / "api.md").write_text(
        '# Python (API)\n\nThe <a href="../api/index.html">reference of all packages</a> is made of docstrings.\n'
    )


def site_links(text: str, source: Path, folder: Path) -> str:
    """Return a page with links that work on the site: what it does not hold, such as sources, loses its link.

    Args:
        text: The page.
        source: Its file in the checkout.
        folder: Folder of the site's pages.
    """

    def rewritten(found: re.Match[str]) -> str:
        image, label, target = found.groups()
        name, _, anchor = target.partition("#")
        if "://" in target or not name:
            return found[0]
        file = (source.parent / name).resolve()
        if not file.is_relative_to(DOCS) or not (folder / file.relative_to(DOCS)).is_file():
            return label
        inner = name.removeprefix("docs/") if source.parent == ROOT else name
        return f"{image}[{label}]({inner}{'#' if anchor else ''}{anchor})"

    text = re.sub(r"^```(\w+) (?!title=).*$", r"```\1", text, flags=re.MULTILINE)  # words for the tests
    return re.sub(r"(!?)\[([^\]\[]*)\]\(([^)\s]+)\)", rewritten, text)


def command_reference() -> str:
    """Return the help of every command as Markdown."""
    import click

    from roboxim_cli.main import group

    lines = ["# Commands", "", "The output of `--help` of every command, written when the site is built."]

    def add(command: click.Command, words: list[str]) -> None:
        context = click.Context(command, info_name=" ".join(words), terminal_width=90)
        lines.extend(["", f"## {' '.join(words)}", "", "```text", command.get_help(context), "```"])
        if isinstance(command, click.Group):
            for name in command.list_commands(context):
                if (child := command.get_command(context, name)) is not None:
                    add(child, [*words, name])

    add(group, ["roboxim"])
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
