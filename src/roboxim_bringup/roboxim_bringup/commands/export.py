"""Export recorded episodes as a dataset."""

from __future__ import annotations

from pathlib import Path

import click


@click.group()
def command() -> None:
    """Export recorded episodes as a dataset."""


@command.command("rlds")
@click.argument("source", type=click.Path(path_type=Path))
@click.argument("target", type=click.Path(path_type=Path))
@click.option("--name", default="roboxim", show_default=True, help="Name of the dataset.")
@click.option("--version", default="1.0.0", show_default=True, help="Version of the dataset.")
@click.option(
    "--camera", "cameras", multiple=True, metavar="CAMERA=KEY",
    help="Camera and its image key; may be repeated. Default: all, workspace=image and wrist=wrist_image.",
)  # fmt: skip
@click.option("--size", default="as-configured", help="Resize images to SIZE or WIDTHxHEIGHT; default: as recorded.")
@click.option(
    "--encoding", type=click.Choice(["jpeg", "png"]), default="jpeg", show_default=True, help="Image encoding."
)
@click.option(
    "--val-fraction", default=0.05, show_default=True, help="Part of the episodes that becomes the split val."
)
@click.option("--all", "everything", is_flag=True, help="Also episodes that did not succeed.")
@click.option("--keep-recovered", is_flag=True, help="Also episodes that needed another try, e.g. a second grasp.")
@click.option("--overwrite", is_flag=True, help="Replace a dataset that is there.")
def rlds(
    source: Path, target: Path, name: str, version: str, cameras: tuple[str, ...], size: str, encoding: str,
    val_fraction: float, everything: bool, keep_recovered: bool, overwrite: bool,
) -> None:  # fmt: skip
    r"""Export the bags of a run as RLDS, loadable by TensorFlow Datasets, Octo and OpenVLA; needs no TensorFlow.

    \b
    roboxim export rlds runs/demos runs/demos-rlds
    roboxim export rlds runs/demos runs/demos-rlds --size 224 --encoding png --name my_dataset

    Writes TARGET/NAME/VERSION. An interrupted export goes on where it stopped.
    """
    from roboxim_bringup.options import parse_size
    from roboxim_bringup.printer import EventPrinter
    from roboxim_bringup.runs.export import export_rlds
    from roboxim_core.errors import ConfigError
    from roboxim_recorder.export.rlds import ExportConfig

    for word in cameras:
        if "=" not in word:
            raise ConfigError(f"--camera is CAMERA=KEY, e.g. workspace=image, got '{word}'")
    width, height = parse_size(size)
    config = ExportConfig(
        name=name, version=version, cameras=dict(word.split("=", 1) for word in cameras), encoding=encoding,
        image_width=width, image_height=height, val_fraction=val_fraction, only_successful=not everything,
        keep_recovered=keep_recovered or everything,
    )  # fmt: skip
    with EventPrinter() as printer:
        report = export_rlds(source, target, config, overwrite=overwrite, on_event=printer)
    splits = ", ".join(
        f"{count} {'episode' if count == 1 else 'episodes'} in {s}" for s, count in report.splits.items()
    )
    click.echo(f"{report.path}: {splits}, {report.steps} steps")
    for reason, count in report.left_out.items():
        click.echo(f"  left out: {count} ({reason})")
    if report.dead_dimensions:
        click.echo(f"  (nearly) constant components of the action, not learnable: {', '.join(report.dead_dimensions)}")
    click.echo(f"next: roboxim train bc {target}")
