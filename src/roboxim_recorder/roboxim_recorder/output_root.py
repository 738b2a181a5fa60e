"""The root of all output folders: a request may write bags only below the folder that the node was started with."""

from __future__ import annotations

from pathlib import Path

from roboxim_core import limits
from roboxim_core.errors import InvalidRequestError
from roboxim_recorder.bag_writer import PARTIAL, PLACES


def require_inside(output_dir: str, root: Path) -> Path:
    """Return a request's folder; reject one outside of the root.

    Args:
        output_dir: Folder of the request, absolute. ``..`` and symbolic links are resolved.
        root: Folder that it must be, or be in.

    Raises:
        InvalidRequestError: On a relative folder, or one from which a bag would leave the root.
    """
    if "\0" in output_dir or not Path(output_dir).is_absolute():
        raise InvalidRequestError(f"the recorder's output folder must be absolute, got {limits.echo(output_dir)}")
    folder = Path(output_dir)
    try:
        written = [(folder / part).resolve() for part in ("", PARTIAL, *PLACES.values())]
    except (OSError, RuntimeError) as error:  # a loop of links, a name that is too long
        raise InvalidRequestError(f"the output folder {limits.echo(output_dir)} cannot be resolved: {error}") from None
    inside = root.resolve()
    for path in written:
        if not path.is_relative_to(inside):
            raise InvalidRequestError(
                f"the output folder {limits.echo(output_dir)} leads to {limits.echo(str(path))}, outside of {inside}; "
                "record below that folder, or start the recorder with another output_root"
            )
    return written[0]
