"""Describe, compare, convert, merge, split and check datasets."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import click

from roboxim_cli import strict
from roboxim_cli.options import option, print_json, require_ending
from roboxim_core.whole_files import write_whole

_PREFIX = "_dataset_"
_path = click.Path(path_type=Path)


class _Subcommands(strict.Group):
    """A group with one subcommand for each ``_dataset_<name>.py`` beside this file, imported when it runs."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the files, with the subcommands that are registered here."""
        files = Path(__file__).parent.glob(f"{_PREFIX}*.py")
        return sorted({*super().list_commands(ctx), *(file.stem.removeprefix(_PREFIX) for file in files)})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a subcommand."""
        registered = super().get_command(ctx, cmd_name)
        if registered is not None or cmd_name not in self.list_commands(ctx):
            return registered
        command: click.Command = importlib.import_module(f"{__package__}.{_PREFIX}{cmd_name}").command
        return command


class _Formats(strict.Group):
    """A group with a subcommand for every registered format of datasets."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the formats."""
        from roboxim_datasets.formats import FORMATS

        return list(FORMATS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Build a format's command from its options."""
        from roboxim_cli.field_options import field_options
        from roboxim_datasets.formats import FORMATS

        if cmd_name not in FORMATS:
            return None
        options = FORMATS[cmd_name]().options
        own = field_options(options)
        doc = (FORMATS[cmd_name].__doc__ or "").splitlines()[0]

        def convert(
            source: Path, out: Path, overwrite: bool, fps: float, depth_unit: float, instruction: str,
            where: tuple[str, ...], **given: Any,
        ) -> None:  # fmt: skip
            from roboxim_datasets.where import with_files

            more = {
                "fps": fps, "depth_unit_m": depth_unit, "instruction": instruction, "overwrite": overwrite,
                "where": with_files(where),
            }  # fmt: skip
            _convert(cmd_name, options(**given), source, out, **more)

        params: list[click.Parameter] = [
            click.Argument(["source"], type=_path),
            click.Option(["--out"], type=_path, required=True, help="Folder of the dataset."),
            *own,
            click.Option(
                ["--fps"], type=click.FloatRange(0), default=0.0,
                help="Steps per second of a source that does not say it.",
            ),
            click.Option(
                ["--depth-unit"], type=click.FloatRange(0), default=0.0, metavar="METRES",
                help="Unit of depth images of a source that does not say it, e.g. 0.001.",
            ),
            click.Option(
                ["--instruction"], default="", metavar="TEXT",
                help="What was done in a bag of 'roboxim bag record', which becomes a dataset, too.",
            ),
            click.Option(
                ["--where"], multiple=True, metavar="CONDITION",
                help="Episodes to take, e.g. outcome=success; or an edit of one; @FILE: a selection file.",
            ),
            click.Option(["--overwrite"], is_flag=True, help="Replace an existing dataset."),
        ]  # fmt: skip
        return strict.Command(
            cmd_name, params=params, callback=convert, short_help=doc, begins="converting",
            help=f"{doc}\n\nThe same command continues an interrupted conversion. The source is only read.",
        )  # fmt: skip


@strict.group(cls=_Subcommands)
def command() -> None:
    """Describe, compare, convert, merge, split and check datasets of any format, RoboXim's or another tool's."""


@command.command("info")
@click.argument("dataset", type=_path)
@click.option("--card", is_flag=True, help="Print the card (README.md) instead.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON, with everything that the files hold.")
def info(dataset: Path, card: bool, as_json: bool) -> None:
    """Describe a dataset: format, episodes, cameras, meaning of the actions, tasks, origin, and what is not read."""
    from roboxim_datasets import card as cards
    from roboxim_datasets.formats import open_dataset

    opened = open_dataset(dataset)
    counts = cards.count(opened)
    if as_json:
        print_json(cards.summary_json(opened, counts))
    else:
        click.echo(cards.card(opened, counts) if card else cards.summary(opened, counts))


@command.command("diff", begins="comparing")
@click.argument("a", type=_path)
@click.argument("b", type=_path)
@click.option(
    "--images", type=click.Choice(["auto", "exact", "psnr", "skip"]), default="auto", show_default=True,
    help="Compare images exactly, or by their PSNR; auto: exactly if both datasets are lossless.",
)  # fmt: skip
@click.option(
    "--psnr",
    type=click.FloatRange(0),
    default=30.0,
    show_default=True,
    help="Lowest PSNR of an image that counts as equal [dB].",
)
@click.option("--ignore", multiple=True, metavar="NAME", help="Camera, vector or signal to leave out; may be repeated.")
def diff(a: Path, b: Path, images: Any, psnr: float, ignore: tuple[str, ...]) -> None:
    """Prove that two datasets of any formats are equal, or name what differs.

    Actions, states and signals are compared bit for bit as float32; lengths, instructions, ids and the order too;
    metadata of episodes are not. The exit code is 1 when they differ.
    """
    from roboxim_cli.printer import EventPrinter
    from roboxim_datasets.compare import comparison_text
    from roboxim_runs.datasets.rewriting import compare_datasets

    with EventPrinter() as printer:
        found = compare_datasets(a, b, images=images, lowest_psnr_db=psnr, ignore_names=ignore, on_event=printer)
    click.echo(comparison_text(found, {"a": str(a), "b": str(b)}))
    if not found.equal:
        raise SystemExit(1)


@command.group("convert", cls=_Formats)
def convert() -> None:
    r"""Write a dataset in another format.

    \b
    roboxim dataset convert lerobot runs/demos-rlds --out runs/demos-lerobot --version 2.1
    """


def _convert(name: str, options: Any, source: Path, target: Path, **more: Any) -> None:
    from roboxim_cli.printer import EventPrinter
    from roboxim_runs.datasets.rewriting import convert_dataset

    with EventPrinter() as printer:
        written = convert_dataset(source, target, name, options, on_event=printer, **more)
    _print_written(written)


@command.command("merge", begins="merging")
@click.argument("sources", type=_path, nargs=-1, required=True)
@option("out", required=True, help="Folder of the dataset.")
@click.option("--partial", is_flag=True, help="Merge although shards of an export are missing.")
@click.option("--overwrite", is_flag=True, help="Replace an existing dataset.")
def merge(sources: tuple[Path, ...], out: Path, partial: bool, overwrite: bool) -> None:
    """Write datasets of one format as one. They must have the same features, meaning of actions and robot.

    The sources are only read. The same command continues an interrupted merge.
    """
    from roboxim_cli.printer import EventPrinter
    from roboxim_runs.datasets.rewriting import merge_datasets

    with EventPrinter() as printer:
        _print_written(merge_datasets(sources, out, partial=partial, overwrite=overwrite, on_event=printer))


@command.command("split", begins="splitting")
@click.argument("source", type=_path)
@option("out", required=True, help="Folder of the dataset.")
@click.option(
    "--into", required=True, metavar="train=90,val=10", help="Splits and their numbers of episodes; 0: the rest."
)
@click.option("--apart", is_flag=True, help="Write each split as a dataset of its own, OUT/<split>.")
@click.option("--overwrite", is_flag=True, help="Replace an existing dataset.")
def split(source: Path, out: Path, into: str, apart: bool, overwrite: bool) -> None:
    """Divide the episodes of a dataset into other splits, each spread evenly over the whole.

    LeRobot's trainers ignore splits: --apart gives them datasets of their own. The source is only read. The same
    command continues an interrupted one.
    """
    from roboxim_cli.options import parse_counts
    from roboxim_cli.printer import EventPrinter
    from roboxim_runs.datasets.rewriting import split_dataset

    with EventPrinter() as printer:
        found = split_dataset(
            source, out, parse_counts("--into", into), apart=apart, overwrite=overwrite, on_event=printer
        )
    for written in {written.path: written for written in found.values()}.values():
        _print_written(written)


@command.command("view", begins="drawing")
@click.argument("dataset", type=_path, metavar="DATASET|RUN|BAG")
@click.option("--episode", type=click.IntRange(0), default=0, show_default=True, help="Number, through all splits.")
@click.option("--frames", type=click.IntRange(1), default=12, show_default=True, help="Frames of each camera.")
@click.option(
    "--out", type=_path, help="File to write: .html (frames and plots), .png or .jpg (frames). "
    "[default: episode-<number>.html]",
)  # fmt: skip
def view(dataset: Path, episode: int, frames: int, out: Path | None) -> None:
    r"""Write a page or a picture of an episode: its frames, and the course of its actions and observations.

    \b
    roboxim dataset view runs/rlds --episode 3
    roboxim dataset view runs/demos --episode 3            # bags, too; roboxim show also says why they ended so
    """
    from roboxim_datasets.view import contact_sheet, encoded, page
    from roboxim_runs.datasets.viewing import viewed_episode

    file = out or Path(f"episode-{episode}.html")
    kinds = {".html": "", ".png": "PNG", ".jpg": "JPEG"}
    require_ending(file, *kinds)
    found, names = viewed_episode(dataset, episode)
    if kinds[file.suffix]:
        write_whole(file, encoded(contact_sheet(found, frames), kinds[file.suffix]))
    else:
        write_whole(file, page(found, names, frames))
    click.echo(f"{file}: {found.instruction} ({found.length} steps)")


def _print_written(written: Any) -> None:
    from roboxim_datasets.account import lines

    splits = ", ".join(f"{count} in {split}" for split, count in written.splits.items())
    click.echo(f"{written.path}: {splits}")
    for line in (*lines("note", written.changed), *lines("left out", written.left_out)):
        click.echo(line)
