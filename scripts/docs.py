"""Check the links of every Markdown file, then write the reference of all packages into `site/`.

The check covers links to files and to headings. It does not follow links to the web.
"""

from __future__ import annotations

import re
import subprocess
import sys
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
    command = [sys.executable, "-m", "pdoc", "--docformat", "google", "--output-directory", str(SITE), *PACKAGES]
    result = subprocess.run(command, cwd=ROOT, check=False)
    if result.returncode == 0:
        print(f"The reference is in {(SITE / 'index.html').relative_to(ROOT)}.")
    return result.returncode


if __name__ == "__main__":
    sys.exit(main())
