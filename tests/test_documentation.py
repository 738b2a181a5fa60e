"""The code in README.md and the documentation works: Python blocks are run or checked, commands are parsed.

A Python block is executed. One that needs a recording, a server or a graph says ``not-run`` after ``python``: it is
compiled, its imports are resolved and its names are defined. ``excerpt`` is a part of something longer: compiled only.
"""

from __future__ import annotations

import ast
import importlib
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import click
import pytest

from roboxim_cli.commands.stages import demo
from roboxim_cli.main import group
from roboxim_core.config_folders import config_names, named_config
from roboxim_core.errors import ConfigError
from roboxim_ros.testing import PATIENCE_S
from roboxim_tasks.skills import SKILLS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
FILES = [
    ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("*/*.md")),
    *sorted((ROOT / "src").glob("*/README.md")),
]  # fmt: skip
OWN_NAMES = ("teapot", "pepper_mill", "shake", "my_arm", "sawyer", "cup")
"""Objects, skills and robots that the documentation instructs the reader to create."""


@dataclass(frozen=True, kw_only=True)
class Block:
    """A fenced block of code."""

    file: str
    line: int
    language: str
    """Info string after the fence, e.g. ``python not-run``."""
    text: str

    def __str__(self) -> str:
        """Name it for pytest."""
        return f"{self.file}:{self.line}"


def blocks() -> Iterator[Block]:
    for path in FILES:
        text = path.read_text()
        for found in re.finditer(r"^```([^\n`]*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
            line = text.count("\n", 0, found.start()) + 1
            yield Block(
                file=str(path.relative_to(ROOT)), line=line, language=found[1].strip(), text=found[2]
            )  # fmt: skip


PYTHON = [block for block in blocks() if block.language.startswith("python")]
RUN = [
    block
    for block in PYTHON
    if block.language == "python"
    and not block.text.startswith("# kitchen/")
    and not block.file.startswith("docs/tutorials/")
]
"""The worked example and the tutorials have tests of their own, test_worked_example.py and test_tutorials.py."""
GENERATED = ("docs/reference/yaml.md",)
MAX_LINES = 250
"""Most lines of a page that people write."""
SERVERS = Path(__file__).parents[1] / "src/roboxim_policies/servers"
"""Modules that a user copies into another environment."""
SHELL = [
    block
    for block in blocks()
    if block.language in ("", "bash", "console") and re.search(r"^(\$ )?roboxim ", block.text, re.MULTILINE)
]


def anchors(path: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and MkDocs make them."""
    text = re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.MULTILINE | re.DOTALL)
    found: set[str] = set()
    for heading in re.findall(r"^#+ (.+)$", text, re.MULTILINE):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        found.add(re.sub(r"[^\w\- ]", "", words).strip().replace(" ", "-"))
    return found


@pytest.mark.parametrize("file", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(file: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", file.read_text(), flags=re.MULTILINE | re.DOTALL)
    dead = []
    for link in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", text)):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = file.parent / name if name else file
        if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            dead.append(link)
    assert not dead, dead


def defined(module: Path) -> set[str]:
    """Return the names that a module defines, also in its classes, without what it imports."""
    found = set()
    for node in ast.walk(ast.parse(module.read_text())):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.AnnAssign | ast.Assign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {target.id for target in targets if isinstance(target, ast.Name)}
    return found


def test_the_architecture_names_the_file_that_defines_a_name() -> None:
    text = (DOCS / "explanation" / "architecture.md").read_text()
    found = re.findall(r"`([A-Za-z_.]+)(?:\(\))?` in `(roboxim_\w+)(/[\w/]+\.py)`", text)
    assert len(found) > 5
    for name, room, path in found:
        assert set(name.split(".")) <= defined(ROOT / "src" / room / (room + path)), f"{room}{path} has no {name}"


@pytest.mark.parametrize("file", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_are_short(file: Path) -> None:
    if str(file.relative_to(ROOT)) not in GENERATED:
        assert len(file.read_text().splitlines()) <= MAX_LINES, "split it by subject, or by kind (see mkdocs.yml)"


@pytest.mark.parametrize("file", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_page_that_names_the_thesis_links_to_it(file: Path) -> None:
    text = file.read_text()
    if str(file.relative_to(ROOT)) not in GENERATED and re.search(r"\bthesis\b(?!\.)", text, re.IGNORECASE):
        assert "glossary.md#the-thesis" in text or file.name == "glossary.md"


@pytest.mark.parametrize("file", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_uv_is_called_where_it_is(file: Path) -> None:
    code = "".join(re.findall(r"^```.*?^```$", file.read_text(), re.MULTILINE | re.DOTALL))
    assert not re.search(r"^uv ", code, re.MULTILINE), (
        "the set-up puts it into .tools/uv/bin; other tools have their own"
    )


def test_every_page_is_in_the_site_s_navigation() -> None:
    named = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2]))
    made = {"index.md", "reference/cli.md", "reference/api.md"}  # by scripts/docs.py
    assert {str(file.relative_to(DOCS)) for file in FILES if file.is_relative_to(DOCS)} | made == named


@pytest.mark.parametrize(
    ("task", "page"),
    [
        ("install", "how-to/installation.md"),
        ("evaluate a policy of my own", "tutorials/first_evaluation.md"),
        ("see and film a scene", "tutorials/scene_and_film.md"),
        ("configure tasks", "tutorials/own_task.md"),
        ("an object", "tutorials/own_object.md"),
        ("make a dataset", "tutorials/datasets.md"),
        ("evaluate a model behind a server", "tutorials/policy_server.md"),
        ("the benchmark", "tutorials/transfer_benchmark.md"),
        ("pytest", "tutorials/pytest.md"),
        ("training loop", "tutorials/training_loop.md"),
        ("evaluate a policy of my own", "how-to/own_policies.md"),
        ("evaluate a model behind a server", "how-to/policies.md"),
        ("see why an episode failed", "how-to/reports.md"),
        ("use it in Gymnasium", "how-to/programs.md"),
        ("configure tasks", "how-to/tasks.md"),
        ("add a skill", "how-to/own_skill.md"),
        ("add a skill, an object", "how-to/objects.md"),
        ("make a dataset", "how-to/data.md"),
        ("run an experiment", "how-to/experiments.md"),
        ("edit scenes and drive by hand", "how-to/studio.md"),
        ("use many machines", "how-to/scale.md"),
    ],
)
def test_the_front_page_leads_to_a_task(task: str, page: str) -> None:
    rows = [row for row in (ROOT / "README.md").read_text().splitlines() if row.startswith("| ") and task in row]
    assert any(f"(docs/{page})" in row for row in rows)


def test_the_front_page_counts_what_there_is() -> None:
    arm, gripper = ["seven", "eight", "nine", "ten"], ["two", "three", "four", "five", "six"]
    thing = ["twenty", "twenty-one", "twenty-two", "twenty-three", "twenty-four"]
    skill = ["thirteen", "fourteen", "fifteen", "sixteen", "seventeen", "eighteen"]
    recipes = {name: named_config("robots", name).with_suffix("") / "recipe.yaml" for name in config_names("robots")}
    arms = [name for name, recipe in recipes.items() if not (recipe.is_file() and "\narm: " in recipe.read_text())]
    said = (
        f"{arm[len(arms) - 7]} arms", f"{gripper[len(config_names('grippers')) - 2]} grippers",
        f"{thing[len(config_names('objects')) - 20]} objects", f"{skill[len(SKILLS) - 13]} skills",
    )  # fmt: skip
    text = (ROOT / "README.md").read_text()
    assert [count for count in said if count not in text] == []
    peers = (ROOT / "docs/explanation/comparison.md").read_text()
    assert f"| {len(SKILLS)} skills, " in peers
    assert f"| {len(arms)} arms; PyBullet |" in peers


@pytest.mark.parametrize("block", PYTHON, ids=str)
def test_python_is_valid_and_its_imports_exist(block: Block, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(SERVERS)
    tree = ast.parse(block.text)
    own = {re.sub(r'.* title="(\w+)\.py"', r"\1", other.language) for other in PYTHON if other.file == block.file}
    assert re.fullmatch(r'python( not-run| excerpt| title="[^"]+")?', block.language)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for name in node.names:
                importlib.import_module(name.name)
        elif isinstance(node, ast.ImportFrom) and node.module not in own:
            module = importlib.import_module(node.module or "")
            for name in node.names:
                if not hasattr(module, name.name):
                    importlib.import_module(f"{node.module}.{name.name}")


def test_python_uses_only_names_that_it_defines(tmp_path: Path) -> None:
    for number, block in enumerate(PYTHON):
        if "excerpt" not in block.language:
            (tmp_path / f"block_{number}.py").write_text(f"# {block}\n{block.text}")
    checked = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "F821", str(tmp_path)],
        capture_output=True, text=True, check=False, timeout=PATIENCE_S,
    )  # fmt: skip
    assert checked.returncode == 0, checked.stdout


@pytest.mark.parametrize("block", RUN, ids=str)
def test_python_runs(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(block.text, str(block), "exec"), {"__name__": "example"})


def commands(text: str) -> Iterator[list[str]]:
    """Yield the commands of a shell block as words; a quoted argument may go over lines."""
    pending = ""
    for line in text.replace("\\\n", " ").splitlines():
        pending += f"{line.removeprefix('$ ')}\n"
        try:
            words = shlex.split(pending, comments=True)
        except ValueError:  # the quote goes on
            continue
        pending = ""
        command: list[str] = []
        for word in [*words, "&&"]:
            if word in ("&&", "||", "&", ">", "|"):
                yield command
                command = []
            else:
                command.append(word)
    assert not pending, f"a quote does not end: {pending}"


def parse(command: click.Command, name: str, words: list[str], parent: click.Context | None = None) -> None:
    """Parse a command line without running it."""
    context = command.make_context(name, list(words), parent)
    if isinstance(command, click.Group):
        rest = [*context._protected_args, *context.args]
        found, sub, arguments = command.resolve_command(context, rest)
        assert sub is not None
        parse(sub, str(found), arguments, context)


def refusal(words: list[str]) -> str:
    """Return the command line's complaint about a command; empty: none."""
    try:
        parse(group, "roboxim", words)
    except (click.exceptions.UsageError, ConfigError) as error:
        return str(error)
    return ""


@pytest.mark.parametrize("block", SHELL, ids=str)
def test_commands_are_valid_on_the_command_line(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for words in commands(block.text):
        if words[:1] == ["make"]:
            bench = words[1].removeprefix("bench-")
            assert words[1] in targets or any(ROOT.glob(f"benchmarks/*/{bench}.py")), words
        if words[:1] != ["roboxim"] or words == ["roboxim"]:
            continue
        complaint = refusal(words[1:])
        readers_own = "does not exist" in complaint or any(f"'{name}'" in complaint for name in OWN_NAMES)
        assert not complaint or readers_own, f"{shlex.join(words)}: {complaint}"


def test_readme_and_make_demo_use_the_same_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    """The steps that README.md shows are those that `make demo` runs."""
    run: list[list[str]] = []
    monkeypatch.setattr(demo, "_step", lambda *words: run.append(list(words)))
    group.main(["demo", "--renderer", "tiny"], standalone_mode=False)
    section = (ROOT / "README.md").read_text().partition("## The main job, step by step")[2]
    shown = [words[1:] for words in commands(re.search(r"```bash\n(.*?)```", section, re.DOTALL)[1]) if words]

    def essence(words: list[str]) -> list[str]:
        """Omit options that are set to their default."""
        options = [("--seed", "0"), ("--workers", "2"), ("--renderer", "tiny"), ("--steps", "1200")]
        left = list(words)
        for option, value in options:
            if option in left and left[left.index(option) + 1] == value:
                del left[left.index(option) : left.index(option) + 2]
        return sorted(left)

    assert [essence(words) for words in shown] == [essence(words) for words in run]


@pytest.mark.slow
@pytest.mark.ros
def test_the_example_of_a_test_passes(tmp_path: Path) -> None:
    (block,) = [block for block in PYTHON if block.file == "README.md" and "conftest.py" in block.text]
    for name, text in re.findall(r"^# (\w+\.py)\n(.*?)(?=^# \w+\.py\n|\Z)", block.text, re.MULTILINE | re.DOTALL):
        (tmp_path / name).write_text(text)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "--rootdir", str(tmp_path), str(tmp_path)],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert "1 passed" in done.stdout


def test_commands_that_reports_print_are_valid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Test the commands in the pages' templates and scripts; what a page fills in stands for a file."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found = []
    for file in sorted((ROOT / "src/roboxim_eval/roboxim_eval/templates").glob("*.*")):
        for text in re.findall(r"roboxim [a-z][^<\"\\#]*", file.read_text()):
            words = shlex.split(re.sub(r"\{\{.*?\}\}", "FILE", text))
            if words[1] in group.list_commands(click.Context(group)):  # else it is prose
                found.append(shlex.join(words))
                complaint = refusal(
                    [*words[1:], *(["FILE"] if text.endswith(" ") and words[1] in ("replay", "show") else [])]
                )
                assert not complaint or "does not exist" in complaint, f"{file.name}: {shlex.join(words)}: {complaint}"
    assert {"roboxim up", "roboxim replay", "roboxim show"} <= set(found)


def test_documents_use_the_terms_of_the_glossary() -> None:
    text = (ROOT / "docs" / "reference" / "glossary.md").read_text()
    rows = re.findall(r"^\| (.+?) \| (.+?) \| ?(.*?) ?\|$", text, re.MULTILINE)[2:]
    refused = sorted({word for _, _, others in rows for word in others.split(", ") if word})
    assert len(rows) >= 40
    assert len(refused) >= 5
    names = [name for name, _, _ in rows]
    assert names == sorted(names, key=str.lower)
    pattern = re.compile(rf"\b(?:{'|'.join(map(re.escape, refused))})s?\b", re.IGNORECASE)
    texts = {path: path.read_text() for path in FILES if path.name != "glossary.md"}
    texts |= {
        path: "\n".join(found[1] for found in re.finditer(r'"""(.*?)"""', path.read_text(), re.DOTALL))
        for path in ROOT.glob("src/*/**/*.py")
        if "tests" not in path.parts
    }
    found = [f"{path.relative_to(ROOT)}: {word[0]}" for path, text in texts.items() for word in pattern.finditer(text)]
    assert not found, found
