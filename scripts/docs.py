"""Check the links of every Markdown file, then build the documentation as a site into `site/`.

The check covers links to files and to headings. It does not follow links to the web. The site has the pages of `docs/`
in the order of `mkdocs.yml`, the README as its front page, the help of every command (`cli.md`), and the reference of
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
    command = [sys.executable, "-m", "pdoc", "--docformat", "google", "--output-directory", str(SITE / "api"), *PACKAGES]
    result = subprocess.run(command, cwd=ROOT, check=False)
    if result.returncode == 0:
        print(f"The site is in {(SITE / 'index.html').relative_to(ROOT)}.")
    return result.returncode


def write_pages(folder: Path) -> None:
    """Write what the site is built from: the pages of `docs/`, the README and the help of all commands."""
    shutil.copytree(ROOT / "docs", folder, ignore=shutil.ignore_patterns("results"))
    shutil.copy(ROOT / "README.md", folder / "index.md")
    for page in folder.glob("*.md"):
        page.write_text(site_links(page.read_text(), front=page.name == "index.md"))
    (folder / "cli.md").write_text(command_reference())
    (folder / "api.md").write_text("# Python (API)\n\nThe [reference of all packages](api/index.html){ target=_blank } is made from their docstrings.\n")


def site_links(text: str, *, front: bool) -> str:
    """Return a page with links that work on the site: what it does not hold, such as sources, loses its link."""

    def rewritten(found: re.Match[str]) -> str:
        label, target = found[1], found[2]
        if "://" in target or target.startswith("#"):
            return found[0]
        target = target.removeprefix("docs/") if front else target
        held = not target.startswith("..") and (ROOT / "docs" / target.partition("#")[0]).is_file()
        return f"[{label}]({target})" if held and not target.startswith("results/") else label

    text = re.sub(r"(?<!!)\[([^\]\[]*)\]\(([^)\s]+)\)", rewritten, text)
    return re.sub(r"!\[([^\]]*)\]\(docs/", r"![\1](", text)


def command_reference() -> str:
    """Return the help of every command as Markdown."""
    import click

    from roboxim_cli.main import group

    lines = ["# Commands", "", "The output of `--help` of every command, written when the site is built."]

    def add(command: click.Command, words: list[str]) -> None:
        context = click.Context(command, info_name=" ".join(words), terminal_width=100)
        lines.extend(["", f"## {' '.join(words)}", "", "```text", command.get_help(context), "```"])
        if isinstance(command, click.Group):
            for name in command.list_commands(context):
                if (child := command.get_command(context, name)) is not None:
                    add(child, [*words, name])

    add(group, ["roboxim"])
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
