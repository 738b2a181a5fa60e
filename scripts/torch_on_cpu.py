"""Makes the torch of the running environment, which is built for CUDA, work without NVIDIA's libraries.

The x86-64 wheel links libraries of 2.5 GB that nothing on a CPU calls. Environments that only read datasets install it
without them (see `scripts/lock.py`). This script puts an empty library of each missing name beside torch's own. Each
defines the symbols that torch wants from it, so that the loader is content; calling one returns an error.
"""

from __future__ import annotations

import re
import subprocess
import sys
import sysconfig
import tempfile
from collections import defaultdict
from pathlib import Path


def main() -> int:
    """Write the missing libraries."""
    folder = Path(sysconfig.get_path("platlib")) / "torch" / "lib"
    wanted: set[str] = set()
    versioned: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))  # library -> version -> symbols
    plain: set[str] = set()
    provided: set[str] = set()
    for library in sorted(folder.glob("*.so*")):
        text = _readelf(library)
        wanted |= set(re.findall(r"\(NEEDED\).*\[(.*?)\]", text))
        files = _files_of_versions(text)
        for name, version in re.findall(r" UND ([A-Za-z_]\w*)(?:@([^\s@]+))?(?: \(\d+\))?$", text, re.MULTILINE):
            if version in files:
                versioned[files[version]][version].add(name)
            elif not version:
                plain.add(name)
        provided |= set(re.findall(r" (?:GLOBAL|WEAK|UNIQUE) +\w+ +\d+ ([A-Za-z_]\w*)", text))
    missing = sorted(name for name in wanted if re.match(r"lib(cu|nccl|nv)", name) and not (folder / name).exists())
    cuda = {name for name in plain - provided if re.match(r"cu[A-Z]|cufft|curand|cusparse|cuFile|nccl|nvshmem", name)}
    for name in missing:
        _write_library(folder / name, versioned[name], cuda)
    print(f"{len(missing)} empty libraries in {folder}")
    return 0


def _readelf(library: Path) -> str:
    command = ["readelf", "--wide", "--dynamic", "--dyn-syms", "--version-info", str(library)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def _files_of_versions(text: str) -> dict[str, str]:
    """Return the version of a symbol to the library that should define it."""
    found, file = {}, ""
    for line in text.splitlines():
        if match := re.search(r"File: (\S+)", line):
            file = match.group(1)
        elif file and (match := re.search(r"Name: (\S+)", line)):
            found[match.group(1)] = file
    return found


def _write_library(path: Path, versions: dict[str, set[str]], plain: set[str]) -> None:
    symbols = plain.union(*versions.values())
    with tempfile.TemporaryDirectory() as folder:
        source, script = Path(folder) / "empty.c", Path(folder) / "empty.map"
        source.write_text("".join(f"int {name}(void) {{ return 1; }}\n" for name in sorted(symbols)))
        nodes = [f"{name} {{ global: {' '.join(s + ';' for s in sorted(of))} }};\n" for name, of in versions.items()]
        script.write_text("".join(nodes))
        options = [f"-Wl,--version-script={script}"] if nodes else []
        command = ["cc", "-shared", "-fPIC", "-w", "-fno-builtin", f"-Wl,-soname,{path.name}", *options]
        subprocess.run([*command, "-o", str(path), str(source)], check=True)


if __name__ == "__main__":
    sys.exit(main())
