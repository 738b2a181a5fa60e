"""Export recorded episodes as a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click


class _Formats(click.Group):
    """A group with a subcommand for every registered format."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the formats."""
        from roboxim_recorder.export import EXPORTERS

        return list(EXPORTERS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Build a format's command from its configuration."""
        from roboxim_bringup.field_options import field_options
        from roboxim_recorder.export import EXPORTERS, Selection

        if cmd_name not in EXPORTERS:
            return None
        exporter = EXPORTERS[cmd_name]
        own = field_options(exporter().config, leave_out=Selection.__dataclass_fields__)
        doc = (exporter.__doc__ or "").splitlines()[0]

        def export(**options: Any) -> None:
            _export(cmd_name, {option.name: options.pop(option.name) for option in own if option.name}, **options)

        return click.Command(
            cmd_name,
            params=[*_common(), *own],
            callback=export,
            short_help=doc,
            help=f"{doc}\n\n\b\nroboxim export {cmd_name} runs/demos runs/demos-{cmd_name}\n\n"
            "The same command continues an interrupted export.",
        )


@click.group(cls=_Formats)
def command() -> None:
    """Export recorded episodes as a dataset."""


def _common() -> list[click.Parameter]:
    """Return the arguments and options that all formats share."""
    path = click.Path(path_type=Path)
    return [
        click.Argument(["source"], type=path),
        click.Argument(["target"], type=path),
        click.Option(
            ["--camera", "cameras"], multiple=True, metavar="CAMERA=KEY",
            help="Camera and its image key; may be repeated. Default: all, workspace=image and wrist=wrist_image.",
        ),
        click.Option(
            ["--size"], default="as-configured", help="Resize images to SIZE or WIDTHxHEIGHT; default: as recorded."
        ),
        click.Option(
            ["--val-fraction"], default=0.05, show_default=True, help="Fraction of the episodes in the split val."
        ),
        click.Option(["--all", "everything"], is_flag=True, help="Include episodes that did not succeed."),
        click.Option(
            ["--keep-recovered"], is_flag=True,
            help="Include episodes that needed a second attempt, e.g. a second grasp."
        ),
        click.Option(
            ["--skip-missing"], is_flag=True, help="Export the remaining bags when bags of the run are missing."
        ),
        click.Option(["--overwrite"], is_flag=True, help="Replace an existing dataset."),
    ]  # fmt: skip


def _export(
    name: str, own: dict[str, Any], source: Path, target: Path, cameras: tuple[str, ...], size: str,
    val_fraction: float, everything: bool, keep_recovered: bool, skip_missing: bool, overwrite: bool,
) -> None:  # fmt: skip
    from roboxim_bringup.options import parse_size
    from roboxim_bringup.printer import EventPrinter
    from roboxim_bringup.runs.export import export_dataset
    from roboxim_core.errors import ConfigError
    from roboxim_recorder.export import EXPORTERS

    for word in cameras:
        if "=" not in word:
            raise ConfigError(f"--camera is CAMERA=KEY, e.g. workspace=image, got '{word}'")
    width, height = parse_size(size)
    config = EXPORTERS[name]().config(
        cameras=dict(word.split("=", 1) for word in cameras), image_width=width, image_height=height,
        val_fraction=val_fraction, only_successful=not everything, keep_recovered=keep_recovered or everything,
        skip_missing=skip_missing, **own,
    )  # fmt: skip
    with EventPrinter() as printer:
        report = export_dataset(name, source, target, config, overwrite=overwrite, on_event=printer)
    splits = ", ".join(
        f"{count} {'episode' if count == 1 else 'episodes'} in {s}" for s, count in report.splits.items()
    )
    click.echo(f"{report.path}: {splits}, {report.steps} steps")
    for reason, count in report.left_out.items():
        click.echo(f"  left out: {count} ({reason})")
    for bag in (*report.missing, *report.unexpected):
        click.echo(f"    {bag} {'is missing' if bag in report.missing else 'has no line in results.jsonl'}")
    if report.dead_dimensions:
        click.echo(f"  (nearly) constant components of the action, not learnable: {', '.join(report.dead_dimensions)}")
    if name == "rlds":
        click.echo(f"next: roboxim train bc {target}")
