"""Stores: bags, datasets and results at a URL of any file system that fsspec knows, e.g. ``s3://bucket/demos``.

A file appears under its own name only when it is complete, and is read back before it counts as stored; its SHA-256 is
kept in ``stored.jsonl`` beside the results. Every reader of a store compares the checksum, so a damaged or replaced
object is reported instead of used. ``run.json``, ``results.jsonl`` and ``stored.jsonl`` are uploaded by
`roboxim_runs.storage.upload`.
"""

from __future__ import annotations

import hashlib
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TypeVar

from roboxim_core.errors import ConfigError, ErrorCode, RecorderError, UnavailableError, counted
from roboxim_core.plain_data.documents import read_json_object
from roboxim_core.plain_data.results_log import REMEDY, RESULTS_FILE, RUN_FILE, LoggedResult, ResultsLog

STORED_FILE = "stored.jsonl"
"""File with a line for each stored bag: its path in the run and the SHA-256 and size of its files."""
SMALL_FILES = (RUN_FILE, RESULTS_FILE, STORED_FILE)
"""Files of a run that are uploaded besides its bags."""
SHARDS = "shards"
"""Folder of a store with such files of each shard, until they are merged."""
SUMS_FILE = "SHA256SUMS"
"""Checksums of a dataset's files, the last file of its upload."""
TRIES = 4
"""Number of attempts at a transfer, with growing pauses."""
PAUSE_S = 1.0
MISSING = "stores need packages that are not installed; install them on all machines with: pip install 'roboxim[store]'"
WHOLE_OBJECTS = ("s3", "s3a", "gs", "gcs", "abfs", "az", "adl", "memory")
"""Protocols whose uploads appear only when complete; elsewhere, a complete file is renamed."""
T = TypeVar("T")


def is_url(place: Path | str) -> bool:
    """Return whether a place is a URL rather than a path."""
    return "://" in str(place)


class Store:
    """A folder at a URL."""

    def __init__(self, url: str, files: Any) -> None:
        """Store the URL and the file system that serves it; see `opened`."""
        self.url = url.rstrip("/")
        self._files = files
        self._root = files._strip_protocol(self.url)
        protocol = files.protocol if isinstance(files.protocol, str) else files.protocol[0]
        self._whole = protocol in WHOLE_OBJECTS

    @classmethod
    @contextmanager
    def opened(cls, url: str) -> Iterator[Store]:
        """Open a store.

        Raises:
            ConfigError: When the packages for it are not installed, or the URL is not one of a store.
        """
        try:
            import fsspec
        except ImportError:
            raise ConfigError(MISSING) from None
        if not is_url(url):
            raise ConfigError(f"a store is a URL, e.g. file:///data/demos or s3://bucket/demos; got '{url}'")
        try:
            files, _ = fsspec.core.url_to_fs(url, use_listings_cache=False)
        except ImportError as error:
            raise ConfigError(f"the store '{url}' needs a package that is not installed: {error}") from None
        except (ValueError, TypeError) as error:
            raise ConfigError(f"'{url}' is not the URL of a store: {error}") from None
        yield cls(url, files)

    def put(self, file: Path, name: str) -> dict[str, Any]:
        """Upload a file completely or not at all, and read it back.

        Args:
            file: The file.
            name: Its name in the store, with slashes.

        Returns:
            Its SHA-256 and size, plain data.

        Raises:
            RecorderError: ``BAG_DAMAGED`` when the store holds something else afterwards.
            UnavailableError: When the store cannot be reached.
        """
        facts = {"sha256": file_sha256(file), "bytes": file.stat().st_size}
        target = self._place(name)

        def upload() -> None:
            if self._whole:
                self._files.put_file(str(file), target)
                return
            partial = f"{target}.{secrets.token_hex(4)}.partial"
            self._files.makedirs(target.rpartition("/")[0], exist_ok=True)
            self._files.put_file(str(file), partial)
            self._files.mv(partial, target)

        self._tried(f"upload {name}", upload)
        if self._tried(f"read {name} back", lambda: self._remote_sha256(target)) != facts["sha256"]:
            raise RecorderError(
                f"{self.url}/{name} differs from the uploaded file; upload again", ErrorCode.BAG_DAMAGED
            )
        return facts

    def put_folder(self, folder: Path, name: str) -> dict[str, Any]:
        """Upload the files of a folder; returns the facts of each by its name. See `put`."""
        return {file.name: self.put(file, f"{name}/{file.name}") for file in sorted(folder.iterdir())}

    def get(self, name: str, file: Path, *, sha256: str = "") -> None:
        """Download a file completely or not at all.

        Args:
            name: Its name in the store.
            file: Destination; its folder is made.
            sha256: Expected checksum; empty: no check.

        Raises:
            RecorderError: ``BAG_DAMAGED`` when it is missing or has another checksum.
            UnavailableError: When the store cannot be reached.
        """
        file.parent.mkdir(parents=True, exist_ok=True)
        partial = file.with_name(f".{file.name}.{secrets.token_hex(4)}.partial")
        try:
            self._tried(f"download {name}", lambda: self._files.get_file(self._place(name), str(partial)))
            if sha256 and file_sha256(partial) != sha256:
                raise RecorderError(
                    f"{self.url}/{name} is not the file that was stored: its SHA-256 differs from {STORED_FILE}; "
                    "restore it, or run the episode again with --repair",
                    ErrorCode.BAG_DAMAGED,
                )
            partial.replace(file)
        finally:
            partial.unlink(missing_ok=True)

    def has(self, name: str) -> bool:
        """Return whether there is a file of the name."""
        return bool(self._tried(f"look for {name}", lambda: self._files.exists(self._place(name))))

    def folders(self, name: str) -> list[str]:
        """Return the names of the folders in a folder, which need not exist."""

        def listed() -> list[dict[str, Any]]:
            try:
                return list(self._files.ls(self._place(name), detail=True))
            except FileNotFoundError:
                return []

        found = self._tried(f"list {name}", listed)
        return sorted(one["name"].rstrip("/").rpartition("/")[2] for one in found if one["type"] == "directory")

    def find(self) -> list[str]:
        """Return the names of all files."""
        found = self._tried("list it", lambda: self._files.find(self._root))
        return sorted(path[len(self._root) :].lstrip("/") for path in found)

    def _place(self, name: str) -> str:
        return f"{self._root}/{name}" if name else self._root

    def _remote_sha256(self, place: str) -> str:
        total = hashlib.sha256()
        with self._files.open(place, "rb") as file:
            while chunk := file.read(1 << 22):
                total.update(chunk)
        return total.hexdigest()

    def _tried(self, what: str, action: Callable[[], T]) -> T:
        """Run an action; repeat it a few times after a lost connection."""
        for attempt in range(1, TRIES + 1):
            try:
                return action()
            except FileNotFoundError as error:
                raise RecorderError(f"cannot {what}: {self.url} has no {error}", ErrorCode.BAG_DAMAGED) from None
            except Exception as error:  # each file system has errors of its own
                if attempt == TRIES or isinstance(error, PermissionError):
                    raise UnavailableError(
                        f"cannot {what} at {self.url}: {type(error).__name__}: {error}; the same command continues "
                        "when the store can be reached"
                    ) from error
                time.sleep(PAUSE_S * 2 ** (attempt - 1))
        raise AssertionError("unreachable")


def file_sha256(file: Path) -> str:
    """Return the hash of a file's content."""
    with open(file, "rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


# ------------------------------------------------------------------ runs


def note_stored(run: Path, bags: Mapping[str, Mapping[str, Any]]) -> None:
    """Append bags that are in the store, by their path in the run, to the run's list; it is on the disk then."""
    if bags:
        ResultsLog(run / STORED_FILE).append("", *({"bag": bag, "files": files} for bag, files in bags.items()))


def stored_bags(run: Path) -> dict[str, dict[str, Any]]:
    """Return the bags of a run that are in its store, with the facts of their files; a torn last line is left out.

    Raises:
        ConfigError: When a line is damaged.
    """
    log, found = ResultsLog(run / STORED_FILE), {}
    for entry in log.read():
        if not _names_files(entry):
            raise ConfigError(f"{log.path} line {entry.line} is not a stored bag; {REMEDY}")
        found[entry.data["bag"]] = entry.data["files"]
    return found


def repair_stored(run: Path) -> None:
    """Drop damaged lines of the list of stored bags; their episodes then count as without a bag."""
    ResultsLog(run / STORED_FILE).repair(_names_files)


def _names_files(entry: LoggedResult) -> bool:
    return isinstance(entry.data.get("bag"), str) and isinstance(entry.data.get("files"), dict)


def _store_of(run: Path) -> str:
    """Return the URL of a run's store."""
    return str(read_json_object(run / RUN_FILE).get("store", ""))


@contextmanager
def local_sources(places: Iterable[Path | str]) -> Iterator[list[Path]]:
    """Provide runs and bags as folders of this machine while the block runs.

    A URL, and a run whose bags are in a store, are downloaded to a temporary folder and compared with their checksums.

    Args:
        places: Paths and URLs of runs or of folders of bags.

    Raises:
        ConfigError: When a URL holds no files.
        RecorderError: ``BAG_DAMAGED`` when a bag is missing in a store or differs from what was stored.
        UnavailableError: When a store cannot be reached.
    """
    with ExitStack() as stack:
        found = []
        for place in places:
            if is_url(place):
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="roboxim-store-")))
                _download(str(place), folder)
                found.append(folder)
            elif stored_bags(Path(place)):
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="roboxim-store-")))
                _gather(Path(place), folder)
                found.append(folder)
            else:
                found.append(Path(place))
        yield found


def _download(url: str, folder: Path) -> None:
    with Store.opened(url) as store:
        names = [name for name in store.find() if not name.endswith(".partial")]  # a killed upload leaves those
        if not names:
            raise ConfigError(f"{url} has nothing in it")
        lists = sorted(name for name in names if Path(name).match(f"{SHARDS}/*/{STORED_FILE}"))
        for name in (*lists, *SMALL_FILES):
            if name in names:
                store.get(name, folder / name)
        known: dict[str, dict[str, Any]] = {}
        for run in (*(Path(name).parent for name in lists), Path()):  # the merged run's list is the newest
            known |= stored_bags(folder / run)
        for bag, files in known.items():
            for name, facts in files.items():
                store.get(f"{bag}/{name}", folder / bag / name, sha256=facts["sha256"])
        for name in names:
            if not (folder / name).exists() and str(Path(name).parent) not in known:
                store.get(name, folder / name)
    if (folder / SUMS_FILE).exists():
        _require_sums(folder, url)


def _require_sums(folder: Path, url: str) -> None:
    """Compare a downloaded dataset with its checksums.

    Raises:
        RecorderError: ``BAG_DAMAGED`` naming the first file that is missing or another one.
    """
    for line in (folder / SUMS_FILE).read_text().splitlines():
        expected, _, name = line.partition("  ")
        if not (folder / name).is_file() or file_sha256(folder / name) != expected:
            raise RecorderError(
                f"{url}/{name} is missing, or not the file that was stored; repeat the upload", ErrorCode.BAG_DAMAGED
            )


def _gather(run: Path, folder: Path) -> None:
    """Collect a run's local and stored bags in one folder."""
    for name in SMALL_FILES:
        if (run / name).exists():
            shutil.copy2(run / name, folder / name)
    fetch_bags(run, _store_of(run), stored_bags(run), folder)
    for place in ("episodes", "set_apart"):
        for bag in (run / place).glob("[!.]*"):
            (folder / place).mkdir(exist_ok=True)
            if not (folder / place / bag.name).exists():
                (folder / place / bag.name).symlink_to(bag.resolve(), target_is_directory=True)


def fetch_bags(run: Path, url: str, bags: Iterable[str], folder: Path) -> None:
    """Download bags of a run into a folder and verify their checksums; bags that are local are skipped.

    Args:
        run: The run's folder.
        url: Its store.
        bags: Paths of the bags in the run.
        folder: Destination; the bags keep their paths.
    """
    known = stored_bags(run)
    with Store.opened(url) as store:
        for bag in bags:
            for name, facts in known.get(bag, {}).items():
                if not (folder / bag / name).exists():
                    store.get(f"{bag}/{name}", folder / bag / name, sha256=facts["sha256"])


@contextmanager
def readable_run(run: Path, bags: Sequence[str]) -> Iterator[Path]:
    """Yield a folder from which bags of a run can be read: the run's, or a temporary one with bags from its store.

    Args:
        run: The run's folder.
        bags: Paths of the bags in the run that will be read.
    """
    if not stored_bags(run) or all((run / bag).exists() for bag in bags):
        yield run
        return
    with tempfile.TemporaryDirectory(prefix="roboxim-store-") as place:
        folder = Path(place)
        fetch_bags(run, _store_of(run), bags, folder)
        for bag in bags:
            if not (folder / bag).exists():
                (folder / bag).parent.mkdir(parents=True, exist_ok=True)
                (folder / bag).symlink_to((run / bag).resolve(), target_is_directory=True)
        yield folder


def upload_dataset(folder: Path, url: str, *, overwrite: bool = False) -> int:
    """Upload a dataset's files; the list of their checksums comes last, as ``SHA256SUMS``.

    Args:
        folder: The dataset's folder.
        url: Destination.
        overwrite: Whether another state of the same files is replaced.

    Returns:
        Number of files.

    Raises:
        ConfigError: When the store has other files, or a complete dataset that differs.
        UnavailableError: When the store cannot be reached.
    """
    with Store.opened(url) as store, tempfile.TemporaryDirectory(prefix="roboxim-store-") as place:
        names = sorted(str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file())
        sums, there = Path(place) / SUMS_FILE, Path(place) / "there"
        sums.write_text("".join(f"{file_sha256(folder / name)}  {name}\n" for name in names))
        found = [name for name in store.find() if not name.endswith(".partial")]  # a killed upload leaves those
        if others := sorted(set(found) - {*names, SUMS_FILE}):
            raise ConfigError(
                f"{url} has {counted(len(others), 'file')} not of {folder}, e.g. {others[0]}, which a reader would "
                "take for a part of it; choose another --store, or empty this one"
            )
        if SUMS_FILE in found and not overwrite:
            store.get(SUMS_FILE, there)
            if there.read_bytes() != sums.read_bytes():
                raise ConfigError(f"{url} has another dataset; --overwrite replaces it, or choose another --store")
        for name in names:
            store.put(folder / name, name)
        store.put(sums, SUMS_FILE)
    return len(names)
