"""Run a benchmark of several experiments, and write its card and report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from roboxim_cli import strict
from roboxim_cli.options import check_report_options, experiment_options, experiment_run, report_options
from roboxim_core.whole_files import write_whole

REPORT = "report"


class _Benchmarks(strict.Group):
    """A subcommand for each file of ``config/benchmark``."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the benchmarks and the fixed subcommands."""
        from roboxim_core.config_folders import config_names

        return [*config_names("benchmark"), *super().list_commands(ctx)]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a fixed subcommand, or the one that runs a benchmark."""
        if found := super().get_command(ctx, cmd_name):
            return found
        if cmd_name not in self.list_commands(ctx) and not cmd_name.endswith((".yaml", ".yml")):
            from roboxim_core.config_folders import config_names
            from roboxim_core.errors import one_of

            if cmd_name in config_names("experiments"):
                ctx.fail(f"'{cmd_name}' is an experiment: roboxim experiment run {cmd_name}")
            ctx.fail(f"no benchmark '{cmd_name}'; {one_of(self.list_commands(ctx), cmd_name)}")
        return _run_command(cmd_name)


@strict.group(cls=_Benchmarks)
def command() -> None:
    """Run a benchmark of several experiments, and write its card and report."""


def _run_command(name: str) -> click.Command:
    @strict.command(name, begins="running the benchmark")
    @experiment_options("EXPERIMENT.CONDITION[.R]")
    @click.option(
        "--experiment", "experiments", multiple=True, metavar="NAME",
        help="Run only this experiment of the benchmark; may be repeated.",
    )  # fmt: skip
    @click.option(
        "--card", "cards", multiple=True, metavar="FILE", type=click.Path(path_type=Path, exists=True, dir_okay=False),
        help="Card of an experiment that ran on another machine; may be repeated.",
    )  # fmt: skip
    def run(out: Path, trained: Path | None, **options: Any) -> None:
        """Run the experiments of this benchmark in subfolders of OUT; the same command continues."""
        from contextlib import nullcontext

        from roboxim_cli.printer import EventPrinter
        from roboxim_runs.experiments.benchmark import BenchmarkRunConfig, run_benchmark

        config, runs_on, trains_on = experiment_run(BenchmarkRunConfig, {
            **options, "benchmark": name, "out": out, "trained": trained or "",
        })  # fmt: skip
        with EventPrinter() as printer, runs_on or nullcontext():
            result = run_benchmark(config, executor=runs_on, training_executor=trains_on, on_event=printer)
        if result.card is None:
            click.echo(f"missing: {', '.join(result.missing)}")
            return
        for sentence in result.card.sentences:
            click.echo(sentence)
        click.echo(f"card: {out / 'card.json'}")
        click.echo(f"report: {out / 'report.html'}")

    return run


@command.command(REPORT, begins="writing the report")
@report_options()
def report(folder: Path | None, card: Path | None, out: Path | None, markdown: Path | None) -> None:
    """Check the results of a benchmark's folder or card, print them, and write FOLDER/report.html."""
    from roboxim_runs.experiments.benchmark import (
        benchmark_card_page,
        benchmark_warnings,
        stored_benchmark_card,
        write_benchmark_report,
    )

    check_report_options(folder, card, out, of="benchmark")
    page = out
    if folder is not None:
        found, page = write_benchmark_report(folder), folder / "report.html"
    else:
        assert card is not None
        found = stored_benchmark_card(card)
        if out is not None:
            write_whole(out, benchmark_card_page(found))
    if markdown is not None:
        from roboxim_eval.report.markdown import benchmark_markdown

        write_whole(markdown, benchmark_markdown(found, warnings=benchmark_warnings(found)))
    click.echo(f"{found.name}, scale {found.scale}")
    for sentence in found.sentences:
        click.echo(f"  {sentence}")
    click.echo(f"  sha256 {found.sha256}")
    for one in (page, markdown):
        if one is not None:
            click.echo(f"report: {one}")
