"""Files that a mesh file names, and their stamps; what places an image on a surface and would not be drawn."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

from roboxim_core.errors import ConfigError

if TYPE_CHECKING:
    import trimesh

Stamp = tuple[tuple[int, int], ...]
"""Times [ns] and sizes [bytes] of files: the key by which what was read of them is kept."""
GLB_MAGIC, HEADER = b"glTF", struct.Struct("<4sIIII")
"""First bytes of a GLB file, and its header: magic, version, size, then size and kind of the JSON."""
NUMBERS = {"-o": "0", "-s": "1", "-t": "0", "-mm": "", "-bm": "", "-boost": "", "-texres": ""}
"""Options of an OBJ material's image that take numbers, and the number at which they change nothing."""
WORDS = ("-blendu", "-blendv", "-cc", "-clamp", "-imfchan", "-type")
"""Options that take a word."""
MOVED = "apply this to the texture coordinates in the program that wrote the file"


def mesh_stamp(path: Path | str) -> Stamp:
    """Return time and size of a mesh file and of the files that it names; a missing file has zeros."""
    return tuple(file_stamp(file) for file in (Path(path), *mesh_references(Path(path)).values()))


def mesh_references(path: Path) -> dict[str, Path]:
    """Return the files that a mesh file names, by name, whether they exist or not.

    These are the material files of an OBJ file and their colour images, and the buffers and images of a glTF file;
    empty for other formats.
    """
    return _references(path, file_stamp(path))


def file_stamp(file: Path) -> tuple[int, int]:
    """Return time [ns] and size [bytes] of a file; zeros if it is missing."""
    try:
        at = file.stat()
    except OSError:
        return 0, 0
    return at.st_mtime_ns, at.st_size


def image_of_map(text: str) -> tuple[str, str]:
    """Return the file that the value of ``map_Kd`` in an OBJ material names, and the options that change its place.

    Args:
        text: The value, e.g. ``-s 1 1 1 -clamp on wood.png``; the name may have blanks and Windows' separators.
    """
    rest, moved = text.strip(), []
    while (found := re.match(r"(-\w+)\s+", rest)) and found[1].lower() in (*NUMBERS, *WORDS):
        option = found[1].lower()
        value = r"(?:[-+]?[\d.]+(?:e[-+]?\d+)?\s+){1,3}" if option in NUMBERS else r"\S+\s+"
        if not (values := re.compile(value, re.IGNORECASE).match(rest, found.end())):
            break
        neutral = NUMBERS.get(option)
        if neutral and any(float(number) != float(neutral) for number in values[0].split()):
            moved.append(f"{option} {values[0].strip()}")
        rest = rest[values.end() :]
    return rest.replace("\\", "/"), " ".join(moved)


def read_scene(path: Path | str, *, merge: bool = False) -> trimesh.Scene:
    """Return a mesh file as trimesh reads it, with the images that it names in any folder and with options.

    Args:
        path: The file.
        merge: Whether equal vertices become one, of formats other than glTF.

    Raises:
        Exception: Of any class, as trimesh's readers do.
    """
    import trimesh

    class Resolver(trimesh.resolvers.FilePathResolver):
        def get(self, name: str) -> bytes:
            return bytes(super().get(image_of_map(name)[0]))

    resolver = Resolver(str(path), allow_anywhere=True)
    how: dict[str, Any] = {} if merge else {"process": False}
    return trimesh.load_scene(path, resolver=resolver, **how)


def refuse_moved_images(path: Path) -> None:
    """Refuse a glTF or OBJ file that moves, turns or repeats an image over a surface; others are not looked at.

    Raises:
        ConfigError: Naming what moves the image, and what to do.
    """
    for _, options in _maps(path):
        if options:
            raise ConfigError(f"the mesh {path} places an image by map_Kd {options}, which is not drawn; {MOVED}")
    for number, material in enumerate(_gltf(path).get("materials", ())):
        surface = material.get("pbrMetallicRoughness", {})
        name = f"the mesh {path} has a material '{material.get('name', number)}'"
        for kind in ("baseColorTexture", "metallicRoughnessTexture"):
            image = surface.get(kind, {})
            transform = image.get("extensions", {}).get("KHR_texture_transform", {})
            moves = (*transform.get("offset", (0, 0)), *transform.get("scale", (1, 1)), transform.get("rotation", 0))
            if moves != (0, 0, 1, 1, 0):
                raise ConfigError(f"{name} that moves its {kind} (KHR_texture_transform), which is not drawn; {MOVED}")
            if transform.get("texCoord", image.get("texCoord", 0)) != 0:
                raise ConfigError(f"{name} whose {kind} has coordinates of its own; give it those of TEXCOORD_0")


def _gltf(path: Path) -> dict[str, Any]:
    """Return the JSON of a glTF or GLB file; empty for others, and for wrong ones, which their reader refuses."""
    if path.suffix.lower() not in (".gltf", ".glb"):
        return {}
    try:
        data = path.read_bytes()
        if data.startswith(GLB_MAGIC):
            data = data[HEADER.size : HEADER.size + HEADER.unpack_from(data)[3]]
        content = json.loads(data)
    except (OSError, ValueError, struct.error):
        return {}
    return content if isinstance(content, dict) else {}


def _maps(obj: Path) -> Iterator[tuple[str, str]]:
    """Yield the images of an OBJ file's materials, and the options that change their place."""
    if obj.suffix.lower() != ".obj":
        return
    for library in re.findall(r"^mtllib\s+(.+?)\s*$", _text(obj), flags=re.M):
        for value in re.findall(r"^\s*map_Kd\s+(.+?)\s*$", _text(obj.parent / library), flags=re.M | re.I):
            yield image_of_map(value)


def _text(file: Path) -> str:
    """Return a file's text; empty if there is no such file."""
    return file.read_text(errors="replace") if file.is_file() else ""


@lru_cache(maxsize=256)
def _references(path: Path, _at: tuple[int, int]) -> dict[str, Path]:
    try:
        entries = [entry for kind in ("buffers", "images") for entry in _gltf(path).get(kind, ())]
        names = [unquote(entry["uri"]) for entry in entries if not entry.get("uri", "data:").startswith("data:")]
    except (AttributeError, TypeError):  # its reader says what is wrong
        return {}
    if path.suffix.lower() == ".obj":
        names = [*re.findall(r"^mtllib\s+(.+?)\s*$", _text(path), flags=re.M), *(image for image, _ in _maps(path))]
    return {name: path.parent / name for name in names}
