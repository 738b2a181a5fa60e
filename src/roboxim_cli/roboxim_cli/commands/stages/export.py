"""Export recorded episodes as a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from roboxim_cli import strict
from roboxim_cli.options import is_given
from roboxim_core.plain_data.shell import shell_line

HINT = "LeRobot 3.0; openpi and GR00T read 2.1 with other columns: --for openpi, --for groot"


class _Formats(strict.Group):
    """A group with a subcommand for every registered format."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the formats."""
        from roboxim_recorder.export import EXPORTERS

        return list(EXPORTERS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Build a format's command from its configuration."""
        from roboxim_cli.field_options import field_options
        from roboxim_recorder.export import EXPORTERS, Selection

        if cmd_name not in EXPORTERS:
            return None
        exporter = EXPORTERS[cmd_name]
        own = field_options(exporter().config, leave_out=Selection.__dataclass_fields__)
        doc = (exporter.__doc__ or "").splitlines()[0]

        def export(trainer: str, **options: Any) -> None:
            from roboxim_runs.datasets.export import trainer_options

            format_options = {option.name: options.pop(option.name) for option in own if option.name}
            given = {name: value for name, value in format_options.items() if is_given(name)}
            if trainer:
                format_options |= trainer_options(trainer, cmd_name, given)
            _export(cmd_name, format_options, **options)
            if cmd_name == "lerobot" and not trainer and not given.keys() & {"version", "columns"}:
                click.echo(f"for lerobot 0.4 and newer (ACT, SmolVLA, ...): {HINT}")

        return strict.Command(
            cmd_name,
            params=[*_common(), *own],
            callback=export,
            short_help=doc,
            help=f"{doc}\n\n\b\nroboxim export {cmd_name} runs/demos --out runs/demos-{cmd_name}\n\n"
            "The same command continues an interrupted export.",
            begins="exporting",
        )


@strict.group(cls=_Formats)
def command() -> None:
    """Export recorded episodes as a dataset."""


OWN = ("cameras", "image_width", "image_height", "split", "only_successful", "rate_hz", "cell_counts")
"""Fields of a selection that options set in another form, or that only experiments set."""


def _common() -> list[click.Parameter]:
    """Return the arguments and options that all formats share."""
    from roboxim_cli.field_options import field_options
    from roboxim_cli.options import SHARED, Place
    from roboxim_recorder.export import Selection

    size = {**SHARED["size"], "help": "Resize images to SIZE or WIDTHxHEIGHT; default: as recorded."}
    return [
        click.Argument(["source"], type=Place(), nargs=-1, required=True, metavar="RUN..."),
        click.Option(["--out"], type=click.Path(path_type=Path), required=True, help="Folder of the dataset."),
        click.Option(
            ["--for", "trainer"], default="", metavar="TRAINER",
            help="Trainer that reads it: act, diffusion, smolvla, pi0, openpi, groot, octo, bc, robomimic, ...",
        ),
        click.Option(
            ["--camera", "cameras"], multiple=True, metavar="CAMERA[=KEY]",
            help="Camera and its image key; may be repeated. Default: all, workspace=image and wrist=wrist_image.",
        ),
        click.Option(["--size"], **size),
        click.Option(["--all", "everything"], is_flag=True, help="Include episodes that did not succeed."),
        click.Option(
            ["--split"], default="", metavar="train=90,val=10",
            help="Numbers of episodes of the splits train, val and test; 0: the rest. Default: --val-fraction."
        ),
        click.Option(
            ["--rate", "rate_hz"], type=click.FloatRange(0), default=0.0, metavar="HZ",
            help="Steps per second; must divide the recorded rate; 0: as recorded.",
        ),
        *field_options(Selection, leave_out=OWN),
        click.Option(["--overwrite"], is_flag=True, help="Replace an existing dataset."),
        click.Option(
            ["--gate"], type=click.IntRange(0), default=0, show_default=True, metavar="EPISODES",
            help="Execute the actions of so many episodes again, and refuse the export if too few succeed.",
        ),
        click.Option(
            ["--workers"], type=click.IntRange(0), default=0, show_default="one for each core from 100 episodes on",
            help="Processes that read and encode episodes, for RLDS, and that execute those of --gate.",
        ),
        click.Option(
            ["--store"], default="", metavar="URL",
            help="Upload the dataset, e.g. to s3://bucket/demos-rlds. Needs roboxim[store]. RUN may be a URL too.",
        ),
    ]  # fmt: skip


def _export(
    name: str, own: dict[str, Any], source: tuple[Path | str, ...], out: Path, cameras: tuple[str, ...], size: str,
    split: str, everything: bool, keep_recovered: bool, overwrite: bool, gate: int, workers: int, store: str,
    **common: Any,
) -> None:  # fmt: skip
    from roboxim_cli.options import parse_counts, parse_size
    from roboxim_cli.printer import EventPrinter
    from roboxim_datasets.where import with_files
    from roboxim_recorder.export import EXPORTERS
    from roboxim_runs.datasets.export import export_dataset
    from roboxim_runs.storage.store import local_sources, upload_dataset

    width, height = parse_size(size)
    config = EXPORTERS[name]().config(
        cameras=_camera_keys(cameras), image_width=width, image_height=height, split=parse_counts("--split", split),
        only_successful=not everything, keep_recovered=keep_recovered or everything,
        where=with_files(common.pop("where")), **common, **own,
    )  # fmt: skip
    with EventPrinter() as printer, local_sources(source) as runs:
        report = export_dataset(
            name, runs, out, config, overwrite=overwrite, gate=gate, workers=workers, on_event=printer
        )
    _print_report(report)
    if store:
        click.echo(f"{store}: {upload_dataset(out, store, overwrite=overwrite)} files uploaded and compared")
    if name == "rlds":
        click.echo(f"next: roboxim train bc {shell_line(out)}")


def _camera_keys(words: tuple[str, ...]) -> dict[str, str]:
    """Return camera to image key."""
    from roboxim_datasets.rlds.episodes import USUAL_KEYS
    from roboxim_runs.episodes.task_choice import camera_words

    given = camera_words(part for word in words for part in word.split(","))
    return {camera: key or USUAL_KEYS.get(camera, camera) for camera, key in given.items()}


def _print_report(report: Any) -> None:
    splits = ", ".join(
        f"{count} {'episode' if count == 1 else 'episodes'} in {s}" for s, count in report.splits.items()
    )
    click.echo(f"{report.path}: {splits}, {report.steps} steps")
    several = len({cell for cells in report.cells.values() for cell in cells}) > 1
    for split, cells in report.cells.items():
        if several:
            click.echo(f"  {split}: " + ", ".join(f"{count} of {cell}" for cell, count in cells.items()))
    if len(report.robots) > 1:
        without = ", ".join(report.columns_left_out)
        click.echo(
            f"  robots: {', '.join(report.robots)}" + (f"; their joints differ: no {without}" if without else "")
        )
    for reason, count in report.left_out.items():
        click.echo(f"  left out: {count} ({reason})")
    for bag in (*report.missing, *report.unexpected):
        click.echo(f"    {bag} {'is missing' if bag in report.missing else 'has no line in results.jsonl'}")
    if report.dead_dimensions:
        click.echo(f"  (nearly) constant components of the action, not learnable: {', '.join(report.dead_dimensions)}")
