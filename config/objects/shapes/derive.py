"""Make this folder's objects of pybullet_data's random shapes: ``python config/objects/shapes/derive.py``.

Each mesh is imported by the default options of `roboxim assets import`, and named by what one sees: a word for its
shape, which a person chose from pictures (`WORDS`), its size and its colour. Colours are those of the shapes' URDFs, as
words of the palette. No two shapes share colour and shape word, so that a name fits one of them, whatever its size.

``--work DIR`` keeps the imports, which take half a minute each, for another call. ``--check`` writes nothing and says
which files differ from what the imports in DIR give.
"""

from __future__ import annotations

import argparse
import filecmp
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import pybullet_data
import trimesh
import yaml

from roboxim_core.config import load_config
from roboxim_core.models.modifiers import PALETTE
from roboxim_core.models.object_config import ObjectConfig
from roboxim_runs.assets.importing import import_mesh

HERE = Path(__file__).resolve().parent
SOURCE = Path(pybullet_data.getDataPath()) / "random_urdfs"
SMALL_M, LARGE_M = 0.075, 0.095
"""Longest side below which a shape is called small, and from which it is called large [m]."""
ROUGHNESS = 0.5
WORDS: dict[str, str] = {
    "042": "bird", "043": "tower", "056": "windmill", "062": "jack", "063": "jack", "064": "fish", "067": "tower",
    "068": "hammer", "070": "turtle", "076": "shuttle", "098": "cross", "100": "jack", "103": "spindle",
    "106": "dagger", "108": "propeller", "113": "propeller", "134": "propeller", "142": "helicopter", "161": "crab",
    "173": "engine", "182": "plane", "183": "mallet", "200": "plug", "202": "crab", "203": "rocket", "221": "chair",
    "260": "crane", "262": "bird", "263": "penguin", "264": "tower", "305": "whale", "307": "robot", "308": "plug",
    "313": "torpedo", "319": "mallet", "335": "mallet", "336": "jack", "341": "castle", "371": "tee",
    "373": "boomerang", "382": "jack", "389": "star", "391": "shuttle", "396": "buoy", "397": "bullet",
    "419": "battery", "420": "robot", "428": "camel", "430": "robot", "437": "plane", "492": "dog", "499": "hammer",
    "511": "pill", "532": "submarine", "534": "robot", "563": "bullet", "569": "dagger", "573": "cactus",
    "579": "castle", "617": "cross", "640": "spinner", "642": "chair", "665": "boomerang", "672": "jack",
    "678": "hammer", "693": "gate", "726": "crab", "735": "tractor", "736": "shuttle", "742": "hammer",
    "768": "spinner", "769": "beetle", "773": "castle", "778": "brick", "790": "crane", "827": "windmill",
    "834": "mallet", "836": "tower", "848": "hammer", "855": "crab", "857": "dart", "858": "rock", "870": "boat",
    "872": "hammer", "873": "turtle", "875": "spinner", "881": "battery", "889": "plane", "891": "spinner",
    "899": "cross", "903": "plane", "935": "bench", "938": "tractor", "947": "spool", "951": "windmill",
    "959": "spool", "966": "tee", "975": "dagger", "987": "battery", "999": "cross",
}  # fmt: skip
"""Number of a shape to the word for it."""


def main() -> int:
    """Import what is missing, then write or compare the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, metavar="DIR", help="keep the imports here (default: nowhere)")
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 when a file differs")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        work, made = options.work or Path(scratch) / "work", Path(scratch) / "made"
        made.mkdir()
        for number in WORDS:
            if not (work / "objects" / f"object_{number}.yaml").is_file():
                say(f"importing {number}")
                import_mesh(SOURCE / number / f"{number}.obj", work / "objects")
        names = named(work / "objects")
        for number, name in names.items():
            write(work / "objects", number, name, made)
        if options.check:
            return compare(made)
        for old in (*HERE.glob("*.yaml"), *HERE.glob("*.glb"), *HERE.glob("*_parts")):
            shutil.rmtree(old) if old.is_dir() else old.unlink()
        shutil.copytree(made, HERE, dirs_exist_ok=True)
        say(f"wrote {len(names)} shapes")
    return 0


def named(objects: Path) -> dict[str, tuple[str, str, str]]:
    """Return size, colour and shape word of each shape; the size is empty between small and large."""
    names: dict[str, tuple[str, str, str]] = {}
    for number, word in WORDS.items():
        longest = max(load_config(objects / f"object_{number}.yaml", ObjectConfig).model("it", objects).size)
        size = "small" if longest < SMALL_M else "large" if longest >= LARGE_M else ""
        taken = {colour for _, colour, other in names.values() if other == word}
        names[number] = (size, next(colour for colour in colours(number) if colour not in taken), word)
    return names


def colours(number: str) -> list[str]:
    """Return the palette's words by their distance from the colour in a shape's URDF, the nearest first."""
    found = re.search(r'rgba="([^"]+)"', (SOURCE / number / f"{number}.urdf").read_text())
    assert found is not None
    rgb = [float(value) for value in found[1].split()[:3]]
    return sorted(PALETTE, key=lambda word: sum(abs(a - b) for a, b in zip(PALETTE[word], rgb, strict=True)))


def write(objects: Path, number: str, name: tuple[str, str, str], out: Path) -> None:
    """Write an imported shape under its name, in its colour."""
    words = [word for word in name if word]
    target, source = "_".join(words), f"object_{number}"
    text = (objects / f"{source}.yaml").read_text().replace(source, target)
    content: dict[str, Any] = yaml.safe_load(text)
    del content["modifiers"]
    (link,) = content["links"]
    link["visual"] = [
        {"kind": "mesh", "mesh": f"{target}.glb",
         "material": {"color": list(PALETTE[name[1]]), "roughness": ROUGHNESS}}
    ]  # fmt: skip
    model = load_config(objects / f"{source}.yaml", ObjectConfig).model("it", objects)
    content = {"name": " ".join(words)} | {key: value for key, value in content.items() if key != "name"}
    content |= {"size": [round(value, 6) for value in model.size], "rest_height": round(model.rest_height, 6)}
    comments = [line for line in text.splitlines() if line.startswith("#")][1:]
    head = "\n".join([f"# Imported from pybullet_data/random_urdfs/{number}/{number}.obj by derive.py", *comments, ""])
    body = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
    (out / f"{target}.yaml").write_text(head + body)
    shutil.copy(objects / f"{source}.glb", out / f"{target}.glb")
    parts = out / f"{target}_parts"
    parts.mkdir()
    for part in (objects / f"{source}_parts").iterdir():
        (parts / part.name).write_text(rounded(trimesh.load_mesh(part, process=False)))


def rounded(part: trimesh.Trimesh) -> str:
    """Return a convex part as text of an OBJ file, rounded to 0.01 mm."""
    hull = trimesh.convex.convex_hull(part.vertices.round(5))
    lines = ["v " + " ".join(f"{value:.5f}" for value in vertex) for vertex in hull.vertices]
    lines += ["f " + " ".join(str(number + 1) for number in face) for face in hull.faces]
    return "\n".join(lines) + "\n"


def compare(made: Path) -> int:
    """Print the files that differ from this folder's; return 1 if there are any."""
    wanted = {path.relative_to(made) for path in made.rglob("*") if path.is_file()}
    suffixes = (".yaml", ".glb", ".obj")
    have = {path.relative_to(HERE) for path in HERE.rglob("*") if path.suffix in suffixes}
    wrong = (wanted ^ have) | {path for path in wanted & have if not filecmp.cmp(made / path, HERE / path, False)}
    say("\n".join(f"differs: {path}" for path in sorted(wrong)) or f"{len(wanted)} files are up to date")
    return int(bool(wrong))


def say(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
