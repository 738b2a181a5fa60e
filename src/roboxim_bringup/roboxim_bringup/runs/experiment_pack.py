"""Moves an experiment or a benchmark: results, checkpoints, cards and reports in one file, without bags and datasets.

What remains suffices for reports, comparisons and further evaluations of the checkpoints. The pack has a manifest with
the hash of each file, by which it is checked when it is unpacked.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from roboxim_bringup.experiment_provenance import file_sha256
from roboxim_bringup.runs.experiment_report import STATE_FILE as EXPERIMENT_FILE
from roboxim_bringup.runs.folder import make_folder
from roboxim_core.documents import parse_json
from roboxim_core.errors import ConfigError
from roboxim_recorder.bag_writer import PARTIAL, PLACES

BENCHMARK_FILE = "benchmark.json"
MANIFEST = "pack.json"
MOST_BYTES = 200_000_000
"""Largest size of a pack, so that it can be moved; see `pack`."""
LEFT_OUT = {*PLACES.values(), PARTIAL, "logs"}
"""Folders of a run that are not packed, wherever they are."""


@dataclass(frozen=True, kw_only=True)
class Pack:
    """What a pack holds."""

    path: Path
    """The file, or the folder that it was unpacked to."""
    files: int
    """Number of files."""
    size: int
    """Size of the file [bytes]."""


def packed_files(out: Path) -> Iterator[Path]:
    """Yield the files of an experiment's or a benchmark's folder that a pack holds, sorted.

    Bags, datasets, logs and hidden files are left out.
    """
    for file in sorted(out.rglob("*")):
        parts = file.relative_to(out).parts
        hidden = any(part.startswith(".") for part in parts)
        dataset = "export" in parts[:-1]
        if file.is_file() and not file.is_symlink() and not hidden and not dataset and not LEFT_OUT & set(parts[:-1]):
            yield file


def pack(out: Path, target: Path, *, most_bytes: int = MOST_BYTES) -> Pack:
    """Pack an experiment's or a benchmark's folder.

    Args:
        out: The folder.
        target: File to write, a gzipped tar archive.
        most_bytes: Largest size of the file.

    Raises:
        ConfigError: When the folder is none, the file exists, or it would be too large; names the largest files.
    """
    if not (out / EXPERIMENT_FILE).exists() and not (out / BENCHMARK_FILE).exists():
        raise ConfigError(f"{out} is not the folder of an experiment or a benchmark: it has no {EXPERIMENT_FILE}")
    if target.exists():
        raise ConfigError(f"{target} exists; remove it, or name another file with --file")
    files = list(packed_files(out))
    manifest = {file.relative_to(out).as_posix(): file_sha256(file) for file in files}
    partial = target.with_name(f".{target.name}.partial")
    try:
        with tarfile.open(partial, "w:gz", compresslevel=6) as archive:
            text = json.dumps({"files": manifest}, indent=1).encode()
            entry = tarfile.TarInfo(MANIFEST)
            entry.size = len(text)
            archive.addfile(entry, io.BytesIO(text))
            for name, file in zip(manifest, files, strict=True):
                archive.add(file, arcname=name, recursive=False)
        size = partial.stat().st_size
        if size > most_bytes:
            largest = sorted(files, key=lambda file: -file.stat().st_size)[:3]
            named = ", ".join(f"{f.relative_to(out)} {f.stat().st_size / 1e6:.0f} MB" for f in largest)
            raise ConfigError(
                f"the pack has {size / 1e6:.0f} MB, more than {most_bytes / 1e6:.0f} MB; its largest files: {named}. "
                "Raise --most, or remove intermediate checkpoints"
            )
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
    return Pack(path=target, files=len(files), size=size)


def unpack(file: Path, out: Path) -> Pack:
    """Unpack an experiment's or a benchmark's folder, and check every file.

    Args:
        file: The pack.
        out: Folder to create; it must not exist, or be empty.

    Raises:
        ConfigError: When the file is no pack, was damaged, or has a name that leaves the folder; or the folder exists.
    """
    if out.exists() and any(out.iterdir()):
        raise ConfigError(f"{out} is not empty; name another folder with --out")
    try:
        with tarfile.open(file, "r:gz") as archive:
            manifest = _manifest(archive, file)
            make_folder(out)
            for name, expected in manifest.items():
                archive.extract(archive.getmember(name), out, filter="data")
                if file_sha256(out / name) != expected:
                    raise ConfigError(f"{file} is damaged: {name} has another hash than its manifest says")
    except (tarfile.TarError, EOFError, KeyError, OSError) as error:
        raise ConfigError(f"{file} is no whole pack: {error}") from None
    return Pack(path=out, files=len(manifest), size=file.stat().st_size)


def _manifest(archive: tarfile.TarFile, file: Path) -> dict[str, str]:
    member = archive.getmember(MANIFEST)
    stream = archive.extractfile(member)
    data = parse_json(stream.read().decode(), source=f"{file}, {MANIFEST}") if stream is not None else None
    files = data.get("files") if isinstance(data, dict) else None
    if not isinstance(files, dict) or not all(isinstance(v, str) for v in files.values()):
        raise ConfigError(f"{file} is no pack: its {MANIFEST} has no files")
    for name in files:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise ConfigError(f"{file} is no pack: '{name}' leaves its folder")
    return {str(name): value for name, value in files.items()}
