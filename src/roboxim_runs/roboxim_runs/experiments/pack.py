"""Packs an experiment or a benchmark into one file: results, checkpoints, cards and reports, no bags and datasets.

The pack suffices for reports, comparisons and further evaluations of the checkpoints. It has a manifest with the hash
of each file, which is checked when the pack is unpacked.

Three quarters of a finished ``bc`` checkpoint are the state of the optimiser, which is not needed any more and is left
out, see `roboxim_policies.learning.checkpoint.policy_only`. The experiment's log and card state the hashes of the
original files; the manifest contains them too.
"""

from __future__ import annotations

import errno
import io
import json
import shutil
import tarfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from roboxim_core import limits
from roboxim_core.errors import ConfigError, ErrorCode, RoboximError
from roboxim_core.plain_data.documents import parse_json
from roboxim_core.plain_data.results_log import ResultsLog
from roboxim_eval.experiments import stages_of
from roboxim_policies.learning.checkpoint_file import checkpoint_file, read_description
from roboxim_recorder.bag_writer import PARTIAL, PLACES
from roboxim_runs.experiments.card import STAGES_FILE
from roboxim_runs.experiments.report import STATE_FILE as EXPERIMENT_FILE
from roboxim_runs.experiments.report import ExperimentFolder
from roboxim_runs.storage.folder import make_folder
from roboxim_runs.storage.store import file_sha256

BENCHMARK_FILE = "benchmark.json"
MANIFEST = "pack.json"
MAX_BYTES = 200_000_000
"""Largest size of a pack, so that it can be moved; see `pack`."""
LEFT_OUT = {*PLACES.values(), PARTIAL, "logs"}
"""Folders of a run that are not packed, at any level."""


@dataclass(frozen=True, kw_only=True)
class Pack:
    """What a pack holds."""

    path: Path
    """The file, or the folder that it was unpacked to."""
    files: int
    """Number of files."""
    size: int
    """Size of the file [bytes]."""
    originals: Mapping[str, str]
    """Path of each checkpoint that it has without the optimiser's state, to the SHA-256 of the whole file."""


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


LARGEST_MANIFEST = 64 << 20
"""A larger manifest is not read [B]; those of experiments have some hundred kB."""
MAX_FACTOR = 100
"""Largest size of what a pack unpacks to, as a multiple of its own; of text it is about 20."""
MAX_FILES = 1_000_000
"""Largest number of files of a pack."""


def pack(out: Path, target: Path, *, most_bytes: int = MAX_BYTES) -> Pack:
    """Pack an experiment's or a benchmark's folder.

    Checkpoints of RoboXim's own policies are packed without the optimiser's state when their training is finished, see
    `finished_trainings`; all other files are packed as they are.

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
        raise ConfigError(f"{target} exists; remove it, or name another file with --out")
    partial, drafts = (target.with_name(f".{target.name}.{kind}") for kind in ("partial", "drafts"))
    shutil.rmtree(drafts, ignore_errors=True)  # a killed call left it
    drafts.mkdir()
    try:
        with (
            tarfile.open(partial, "w:gz", compresslevel=6) as archive,
        ):
            files, originals = _contents(out, drafts)
            manifest = {name: file_sha256(file) for name, file in files.items()}
            sizes = {name: file.stat().st_size for name, file in files.items()}
            text = json.dumps({"files": manifest, "originals": originals}, indent=1).encode()
            entry = tarfile.TarInfo(MANIFEST)
            entry.size = len(text)
            archive.addfile(entry, io.BytesIO(text))
            for name, file in files.items():
                archive.add(file, arcname=name, recursive=False)
        size = partial.stat().st_size
        if size > most_bytes:
            largest = sorted(sizes, key=lambda name: -sizes[name])[:3]
            named = ", ".join(f"{name} {sizes[name] / 1e6:.0f} MB" for name in largest)
            raise ConfigError(
                f"the pack has {size / 1e6:.0f} MB, more than {most_bytes / 1e6:.0f} MB; its largest files: {named}. "
                "Raise --largest, or remove intermediate checkpoints"
            )
        shutil.rmtree(drafts)
        partial.replace(target)  # the last step: a call killed before leaves what the next one removes
    finally:
        partial.unlink(missing_ok=True)
        shutil.rmtree(drafts, ignore_errors=True)
    return Pack(path=target, files=len(files), size=size, originals=originals)


def finished_trainings(out: Path) -> Iterator[Path]:
    """Yield the folders of an experiment's trainings whose checkpoints are only evaluated from now on.

    These are trainings that the log of stages names, with their checkpoints on a learning curve. A training is left out
    while an evaluation of it is begun and not finished, since that continues only with the same file. A folder of
    another version of RoboXim has none.

    Args:
        out: The experiment's folder.
    """
    try:
        stages = stages_of(ExperimentFolder.of(out).design)
        done = {entry.data.get("stage") for entry in ResultsLog(out / STAGES_FILE).read()}
    except ConfigError:
        return
    begun = [s for s in stages if s.kind == "evaluate" and s.name not in done and (out / s.name).exists()]
    needed = {need for stage in begun for need in stage.needs}
    for stage in stages:
        if stage.kind == "train" and stage.name in done and stage.name not in needed:
            folder = out / stage.name
            yield from (folder, *sorted(folder.parent.glob(f"{folder.name}@*")))


def _contents(out: Path, drafts: Path) -> tuple[dict[str, Path], dict[str, str]]:
    """Return what a pack holds: names to files, and names of shortened checkpoints to the hash of the whole file.

    Args:
        out: The folder to pack.
        drafts: Folder for the shortened checkpoints.
    """
    files = {file.relative_to(out).as_posix(): file for file in packed_files(out)}
    experiments = [file.parent for file in files.values() if file.name == EXPERIMENT_FILE]
    finished = {checkpoint_file(folder) for one in experiments for folder in finished_trainings(one)}
    originals = {}
    for number, (name, file) in enumerate(files.items()):
        if file in finished and (found := _shortened(file, drafts / str(number))):
            files[name], originals[name] = found
    return files, originals


def _shortened(file: Path, draft: Path) -> tuple[Path, str] | None:
    """Write an own checkpoint without the optimiser's state; return the file to pack, and the whole one's hash.

    One that has none already is its own draft. None: the file is no such checkpoint of this version.
    """
    try:
        description = read_description(file)
        from roboxim_policies.learning.checkpoint import ORIGINAL, policy_only  # importing JAX takes a second

        if ORIGINAL in description:
            return file, str(description[ORIGINAL])
        draft.write_bytes(policy_only(file))
    except (ConfigError, KeyError, TypeError):
        return None
    return draft, str(read_description(draft)[ORIGINAL])


def unpack(file: Path, out: Path) -> Pack:
    """Unpack an experiment's or a benchmark's folder, and check every file.

    Args:
        file: The pack.
        out: Folder to create; it must not exist, or be empty.

    Raises:
        ConfigError: When the file is no pack, was damaged, or has a name that leaves the folder; or the folder exists.
            What was written is removed.
        RoboximError: ``DISK`` when the disk is full.
    """
    if out.exists() and any(out.iterdir()):
        raise ConfigError(f"{out} is not empty; name another folder with --out")
    make_folder(out.parent)
    partial = out.with_name(f".{out.name}.partial")
    try:
        with tarfile.open(file, "r:gz") as archive:
            manifest, originals = _manifest(archive, file)
            _require_bounds(archive, file)
            shutil.rmtree(partial, ignore_errors=True)
            make_folder(partial)
            for name, expected in manifest.items():
                archive.extract(archive.getmember(name), partial, filter="data")
                if file_sha256(partial / name) != expected:
                    raise ConfigError(f"{file} is damaged: {name} has a hash that differs from its manifest")
        if out.exists():
            out.rmdir()
        partial.replace(out)
    except (tarfile.TarError, EOFError, KeyError, zlib.error, UnicodeDecodeError, ValueError) as error:
        raise ConfigError(f"{file} is not a complete pack: {error}") from None
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise RoboximError(
                f"cannot write {out}: {error.strerror}; free some space and run again", ErrorCode.DISK
            ) from None
        raise ConfigError(f"{file} is not a complete pack: {error}") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return Pack(path=out, files=len(manifest), size=file.stat().st_size, originals=originals)


def _require_bounds(archive: tarfile.TarFile, file: Path) -> None:
    """Refuse a pack that would unpack to much more than it has itself; no file of it is kept in memory or written.

    Raises:
        ConfigError: Naming the file at which it exceeds the bounds.
    """
    max_bytes = MAX_FACTOR * file.stat().st_size + LARGEST_MANIFEST
    total = 0
    for number, member in enumerate(archive, start=1):
        total += member.size
        if total > max_bytes or number > MAX_FILES:
            raise ConfigError(
                f"{file} is no pack: it has {file.stat().st_size / 1e6:.1f} MB and would unpack to more than "
                f"{max_bytes / 1e6:.0f} MB or {MAX_FILES} files, at {limits.echo(member.name)}"
            )


def _manifest(archive: tarfile.TarFile, file: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Return names to hashes of a pack's files, and of the whole files of its shortened checkpoints."""
    member = archive.next()
    if member is None or member.name != MANIFEST or member.size > LARGEST_MANIFEST:
        raise ConfigError(
            f"{file} is no pack: it does not begin with a {MANIFEST} of at most {LARGEST_MANIFEST / 1e6:.0f} MB"
        )
    stream = archive.extractfile(member)
    data = parse_json(stream.read().decode(), source=f"{file}, {MANIFEST}") if stream is not None else None
    files = data.get("files") if isinstance(data, dict) else None
    if not isinstance(files, dict) or not all(isinstance(v, str) for v in files.values()):
        raise ConfigError(f"{file} is no pack: its {MANIFEST} has no files")
    for name in files:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise ConfigError(f"{file} is no pack: '{name}' leaves its folder")
    originals = data.get("originals", {}) if isinstance(data, dict) else {}
    if not isinstance(originals, dict) or not originals.keys() <= files.keys():
        raise ConfigError(f"{file} is no pack: its {MANIFEST} names originals of files that it does not have")
    return {str(name): value for name, value in files.items()}, {str(n): str(v) for n, v in originals.items()}
