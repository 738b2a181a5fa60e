"""Plan, run, report and compare experiments: which training condition is better, and how certain is that."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from roboxim_cli import strict
from roboxim_cli.commands.stages import _experiment_calibrate, _experiment_collect, _experiment_rotate
from roboxim_cli.named import Named
from roboxim_cli.options import (
    check_report_options,
    experiment_options,
    experiment_run,
    option,
    print_json,
    report_options,
)
from roboxim_core.errors import counted
from roboxim_core.plain_data.shell import shell_line
from roboxim_core.whole_files import write_whole

if TYPE_CHECKING:
    from collections.abc import Mapping

    from roboxim_eval.experiments import ExperimentConfig, Rates


@strict.group()
def command() -> None:
    """Plan, run, report and compare experiments: which training condition is better, and how certain is that."""


@command.command("list")
def list_experiments() -> None:
    """List the experiments and benchmarks, with the time that each scale takes on this machine.

    A file that is invalid is reported as an error at the end, after the others.
    """
    from roboxim_cli.catalog import catalog
    from roboxim_core.errors import ConfigError

    known = catalog("experiments")
    width = max(map(len, [*known["experiments"], *known["benchmarks"]]), default=0)
    click.secho("experiments (roboxim experiment plan NAME --scale SCALE)", bold=True)
    for name, entry in known["experiments"].items():
        scales = ", ".join(f"{scale} {time}".rstrip() for scale, time in entry["scales"].items())
        click.echo(f"  {name:<{width}} {entry['thesis'] or '-':<7} {entry['about']}")
        click.echo(f"  {'':<{width}} {'':<7} {scales}")
    click.secho("benchmarks (roboxim experiment plan --benchmark NAME --scale SCALE)", bold=True)
    for name, entry in known["benchmarks"].items():
        click.echo(f"  {name:<{width}} {entry['thesis'] or '-':<7} {entry['about']}")
        scales = ", ".join(f"{scale} {time}".rstrip() for scale, time in entry["scales"].items())
        click.echo(f"  {'':<{width}} {'':<7} {', '.join(entry['experiments'])}")
        click.echo(f"  {'':<{width}} {'':<7} {scales}")
    if not known["measured"]:
        click.echo("times are unknown: 'roboxim experiment calibrate' measures this machine's rates in a few minutes")
    if known["broken"]:
        raise ConfigError("\n".join(known["broken"].values()))


@command.command("plan", begins="planning")
@click.argument("name", type=Named("experiment"), default="")
@click.option("--benchmark", default="", help="Plan all experiments of a benchmark of config/benchmark instead.")
@option("scale")
@option("trainer")
@click.option("--budget", default="", metavar="TIME", help="Time that it may take, e.g. 8h or 90min; trainings first.")
@click.option(
    "--from", "cards", multiple=True, type=click.Path(path_type=Path, exists=True, dir_okay=False), metavar="CARD",
    help="Earlier card.json whose spread decides what the budget buys; give several to pool them.",
)  # fmt: skip
@option("trainings", help="Trainings at a time, as for 'experiment run'.")
@click.option("--no-probe", is_flag=True, help="Do not measure this machine for a minute if no rates are stored.")
@click.option("--write", type=click.Path(path_type=Path), help="Folder for the task mixes that it consists of.")
@option("out", metavar="FILE", help="Write the experiment of this scale and budget, for 'experiment run FILE'.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def plan(
    name: str, benchmark: str, scale: str, trainer: str, budget: str, cards: tuple[Path, ...], trainings: int,
    no_probe: bool, write: Path | None, out: Path | None, as_json: bool,
) -> None:  # fmt: skip
    r"""Print what an experiment runs, how long it takes, and which difference it can find. Starts none of it.

    Times come from this machine's last run of the experiment. If there is none with this image size, or none with so
    many trainings at a time, a probe of about a minute measures them.

    \b
    roboxim experiment plan skill_object --scale laptop
    roboxim experiment plan skill_object --scale laptop --budget 8h --out mine.yaml
    roboxim experiment plan skill_object --scale laptop --budget 8h --from runs/so/card.json
    roboxim experiment plan skill_object --scale laptop --trainings 2
    roboxim experiment plan --benchmark transfer --scale night
    """
    from roboxim_core.errors import ConfigError
    from roboxim_runs.experiments.calibration.rates import stored_rates
    from roboxim_runs.experiments.files import (
        benchmark_experiments,
        checked_design,
        fitted_experiment,
        known_as,
        load_benchmark,
        load_experiment,
        run_words,
        write_experiment,
        write_mixes,
    )
    from roboxim_runs.experiments.plan import hours, known_cost, plan_data, plan_lines

    if bool(name) == bool(benchmark):
        raise ConfigError("name one experiment, or --benchmark NAME")
    if cards and not budget:
        raise ConfigError("--from decides what a budget buys: give --budget TIME too")
    if benchmark and out is not None:
        raise ConfigError("--out writes one experiment; plan each experiment of the benchmark by its name")
    configs = (
        benchmark_experiments(load_benchmark(benchmark), scale, trainer)
        if benchmark
        else {name: load_experiment(name, scale, trainer=trainer)}
    )
    at_once = {
        key: trainings if budget else _at_once(key, config, trainer, trainings) for key, config in configs.items()
    }
    rates_of: dict[str, Rates | None] = {}
    for key, config in configs.items():
        rates_of[key] = known = stored_rates(config.image_size, known_as(key))
        if config.datasets and not no_probe:
            rates_of[key] = _experiment_calibrate.probed(key, config, known, at_once[key])
    if budget:
        if None in rates_of.values():
            raise ConfigError("--budget needs this machine's rates: run 'roboxim experiment calibrate' first")
        seconds = duration_s(budget) / len(configs)
        for key, config in configs.items():
            rates = rates_of[key]
            assert rates is not None
            sized, lines = _sized(key, config, rates, seconds, trainer, trainings, cards)
            configs[key] = fitted_experiment(key, scale, sized, trainer)
            for line in lines:
                click.echo(line, err=as_json)
    designs = {key: checked_design(key, config, trainer) for key, config in configs.items()}
    if as_json:
        plans = [plan_data(key, scale, design, rates_of[key], trainings) for key, design in designs.items()]
        print_json(plans)
    else:
        for key, design in designs.items():
            click.echo("\n".join(plan_lines(key, scale, design, rates_of[key], trainings)))
        costs = [cost for key, design in designs.items() if (cost := known_cost(design, rates_of[key], trainings))]
        if len(designs) > 1 and len(costs) == len(designs):
            disk = sum(cost.disk_bytes for cost in costs) / 1e9
            click.echo(f"in all: {hours(sum(cost.total_s for cost in costs))}, {disk:.1f} GB")
    if out is not None:
        write_experiment(configs[name], out)
        click.echo(f"wrote {out}: {run_words(out, configs[name], trainer)}", err=as_json)
    if write is not None:
        for key, design in designs.items():
            for path in write_mixes(design, write / key if benchmark else write):
                click.echo(f"wrote {path}", err=as_json)


@command.command("run", begins="running the experiment")
@click.argument("name", type=Named("experiment"))
@experiment_options("CONDITION[.R]")
@click.option(
    "--shard", default="", metavar="I/N",
    help="Run only the I-th of N parts of the episodes; with --only generate or --only evaluate.",
)  # fmt: skip
def run(name: str, out: Path, shard: str, trained: Path | None, **options: Any) -> None:
    r"""Run the stages of an experiment that OUT lacks: demonstrations, exports, trainings, evaluations.

    \b
    roboxim experiment run skill_object --scale smoke --out runs/smoke
    roboxim experiment run skill_object --scale laptop --trainings 2 --out runs/so
    roboxim experiment run skill_object --only generate,export --out runs/so
    roboxim experiment run skill_object --trainer external --out runs/so --policy leave_out.0=client.py:Octo ...
    roboxim experiment run skill_object --trainer my_trainer.yaml --out runs/mine

    Ctrl-C stops, and trainings save their checkpoints; the same command continues. A stage whose inputs have changed is
    refused by name. When all evaluations are there, OUT/card.json has the counts, scores and sentences.

    \b
    In fresh scenes, on which no policy can have been tuned:
    roboxim experiment run skill_object --scale laptop --fresh --out runs/mine
    roboxim experiment run skill_object --scale laptop --fresh --trained runs/so --out runs/so-fresh    # once more

    \b
    On several machines, here two, each with a folder of its own:
    roboxim experiment run skill_object --only generate --shard 1/2 --out runs/so-1      # and 2/2 to runs/so-2
    roboxim merge runs/so-1 runs/so-2 --out runs/so
    roboxim experiment run skill_object --only generate,export,train --out runs/so
    roboxim experiment run skill_object --only evaluate --shard 1/2 --trained runs/so --out runs/so-1
    roboxim merge runs/so-1 runs/so-2 --out runs/so
    roboxim experiment run skill_object --out runs/so                                    # proofs and results
    """
    from contextlib import nullcontext

    from roboxim_cli.printer import EventPrinter
    from roboxim_runs.experiments.run import run_experiment
    from roboxim_runs.experiments.run_config import ExperimentRunConfig

    fields = {**options, "experiment": name, "out": out, "shard": shard, "trained": trained or ""}
    config, runs_on, trains_on = experiment_run(ExperimentRunConfig, fields)
    with EventPrinter() as printer, runs_on or nullcontext():
        result = run_experiment(config, on_event=printer, executor=runs_on, training_executor=trains_on)
    if shard:
        click.echo(f"shard {shard} has its episodes of: {', '.join(result.finished) or 'no stage'}")
        merge = shell_line("roboxim", "merge", out, "...", "--out", trained or "WHOLE")
        click.echo(f"next, when all shards are there: {merge}")
        return
    click.echo(f"{len(result.finished)} of {len(result.finished) + len(result.missing)} stages are finished in {out}")
    if result.card is None:
        click.echo(f"missing: {', '.join(result.missing)}")
        for name in result.waiting:
            key = name.removeprefix("evaluate/")
            click.echo(f"{name} waits for a policy that is trained elsewhere: name it with --policy {key}=SPEC")
        return
    for sentence in result.card.sentences:
        click.echo(sentence)
    click.echo(f"card: {out / 'card.json'}")
    click.echo(f"report: {out / 'report.html'}")


@command.command("attest", begins="attesting")
@option("out", required=True, help="Folder of the experiment's or benchmark's run; need not exist.")
def attest(out: Path) -> None:
    r"""Draw the seed of fresh scenes before any training, and print a hash that commits to it.

    \b
    roboxim experiment attest --out runs/mine       # publish the line that it prints
    roboxim experiment run skill_object --out runs/mine

    The hash does not give the seed away. The card of the run names the seed, so that everybody can check the hash.
    """
    from roboxim_runs.experiments.scenes.again import attested_seed

    seed = attested_seed(out)
    click.echo(f"scenes committed to: {seed.commitment}")
    click.echo("publish this line before you train; the card of the run will name nonce and seed")


@command.command("report", begins="writing the report")
@report_options()
@click.option("--films", type=click.IntRange(0), default=8, show_default=True, help="Films of each condition.")
@click.option("--evaluations", is_flag=True, help="Also write a page for each evaluation, beside its bags.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def report(
    folder: Path | None, card: Path | None, out: Path | None, markdown: Path | None, films: int, evaluations: bool,
    as_json: bool,
) -> None:  # fmt: skip
    r"""Check the results of a run's folder or of a card, print them, and write a page.

    \b
    roboxim experiment report runs/so                           # writes runs/so/report.html
    roboxim experiment report runs/so --evaluations             # and runs/so/evaluate/*/report.html
    roboxim experiment report --from card.json --out page.html

    Scores and sentences are computed again from the counts. A card that states others is refused, and so is one whose
    results have changed. The page is one file that opens offline.
    """
    from roboxim_core.errors import ConfigError
    from roboxim_eval.experiments.fresh import committed_text, public_text
    from roboxim_eval.report.scores import no_baseline_line
    from roboxim_runs.experiments.report import (
        ExperimentFolder,
        card_page,
        card_warnings,
        curve_lines,
        folder_card,
        spread_lines,
        stored_card,
        write_evaluation_pages,
        write_experiment_report,
    )

    check_report_options(folder, card, out, of="run")
    if evaluations and folder is None:
        raise ConfigError("--evaluations needs the folder of a run: a card has no episodes")
    pages: list[Path] = []
    if folder is not None:
        there = ExperimentFolder.of(folder)
        found = folder_card(there)
        page: Path | None = write_experiment_report(there, found, films=films)
        pages = write_evaluation_pages(there) if evaluations else []
    else:
        assert card is not None
        found = stored_card(card)
        page = out
        if out is not None:
            write_whole(out, card_page(found))
    if markdown is not None:
        from roboxim_eval.report.markdown import experiment_markdown

        write_whole(markdown, experiment_markdown(found, warnings=card_warnings(found)))
    if as_json:
        from roboxim_runs.experiments.report import report_data

        click.echo(report_data(found, [one for one in (page, *pages, markdown) if one is not None]))
        return
    click.echo(f"{found.experiment.name}, scale {found.experiment.scale}")
    for sentence in (*found.sentences, *card_warnings(found), *curve_lines(found)):
        click.echo(f"  {sentence}")
    scores = dict(found.scores or {})
    refused = scores.pop("relative_refused", "")
    for name, value in scores.items():
        text = f"refused: {refused}" if name == "relative" and refused else _score_text(value)
        click.echo(f"  {name:<17} {text}")
    if line := no_baseline_line(found):
        click.echo(f"  note              {line}")
    if scenes := committed_text(found):
        click.echo(f"  scenes            {scenes}")
    if advantage := public_text(found):
        click.echo(f"  public - fresh    {advantage}")
    for line in spread_lines(found):
        click.echo(f"  {line}")
    for sentence in found.experiment.deviations:
        click.echo(f"  deviation         {sentence}")
    click.echo(f"  sha256            {found.sha256}")
    for one in (page, *pages, markdown):
        if one is not None:
            click.echo(f"report: {one}")


def _score_text(value: object) -> str:
    """Format a score: a value with its interval, or that it was not measured."""
    if isinstance(value, dict):
        return f"{_score_text(value['rate'])} of {value['failed']} failures; {value['worst'] or 'none'}"
    if isinstance(value, list):
        middle, low, high = ("unbounded" if x is None else f"{round(x, 2) + 0:.2f}" for x in value)
        return f"{middle} ({low} to {high})"
    return "not measured"


@command.command("compare", begins="comparing")
@click.argument("folders", nargs=-1, required=True, type=click.Path(path_type=Path, exists=True))
@click.option("--condition", default="", help="Condition; default: the first one of the primary comparison.")
@click.option("--where", type=click.Choice(["unseen", "seen", "all"]), default=None, help="Cells; default: as primary.")
@option("out", help="File of the page; default: none.")
def compare(folders: tuple[Path, ...], condition: str, where: str | None, out: Path | None) -> None:
    r"""Compare models: the same condition of several runs of an experiment, on the cells that all of them met.

    \b
    roboxim experiment compare runs/octo runs/bc runs/mine --out models.html

    Cards alone (card.json, or a folder with one) can be compared, too. A model is named by its folder, and by those
    above it where two are called alike. Models without a common letter differ after Holm's adjustment for all pairs.
    """
    from roboxim_runs.experiments.models import compared

    models, cards = compared(folders, condition=condition, where=where or "")
    width = max(map(len, models.models))
    where = "" if models.where == "all" else f"{models.where} "
    click.echo(f"condition {models.condition}, {counted(len(models.cells), f'{where}cell')}")
    for name, model in models.models.items():
        rate = f"{100 * model.rate.value:.0f} % ({100 * model.rate.low:.0f} to {100 * model.rate.high:.0f})"
        trained = counted(model.trainings, "training")
        click.echo(f"  {name:<{width}}  {model.letters:<4} {rate}, {model.successes} of {model.episodes}, {trained}")
    for sentence in models.sentences:
        click.echo(f"  {sentence}")
    if out is not None:
        from roboxim_eval.report.models import models_page

        write_whole(out, models_page(models, cards, _pages_beside(out, dict(zip(cards, folders, strict=True)))))
        click.echo(f"report: {out}")


def _pages_beside(html: Path, folders: Mapping[str, Path]) -> dict[str, str]:
    """Return the address of each run's own page, from that of a page beside them, by the model's name."""
    import os
    from urllib.parse import quote

    pages = {name: folder.resolve() / "report.html" for name, folder in folders.items() if folder.is_dir()}
    start = html.resolve().parent
    return {name: quote(os.path.relpath(page, start)) for name, page in pages.items() if page.exists()}


@command.command("pack", begins="packing")
@click.argument("folder", type=click.Path(path_type=Path, exists=True, file_okay=False))
@option("out", help="File to write; default: FOLDER.tar.gz.")
@click.option("--largest", default=200, show_default=True, type=click.IntRange(1), help="Largest size [MB].")
def pack_run(folder: Path, out: Path | None, largest: int) -> None:
    """Pack results, checkpoints, cards and reports of a run into one file, without bags and datasets."""
    from roboxim_runs.experiments.pack import pack

    found = pack(folder, out or folder.with_name(f"{folder.resolve().name}.tar.gz"), most_bytes=largest * 1_000_000)
    click.echo(f"{counted(found.files, 'file')}, {found.size / 1e6:.1f} MB: {found.path}")


@command.command("unpack", begins="unpacking")
@click.argument("file", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder to create.")
def unpack_run(file: Path, out: Path) -> None:
    """Unpack a run's file, and check the hash of every file in it."""
    from roboxim_runs.experiments.pack import unpack

    found = unpack(file, out)
    see = shell_line("roboxim", "experiment", "report", found.path)
    click.echo(f"{counted(found.files, 'file')} in {found.path}; see: {see}")


command.add_command(_experiment_calibrate.command)
command.add_command(_experiment_collect.collect)
command.add_command(_experiment_rotate.rotate)
command.add_command(_experiment_rotate.join)


def _sized(
    name: str, config: ExperimentConfig, rates: Rates, seconds: float, trainer: str, trainings: int,
    cards: tuple[Path, ...],
) -> tuple[ExperimentConfig, list[str]]:  # fmt: skip
    """Return the experiment that a time buys, and notes about it.

    Raises:
        ConfigError: When no size fits, or a card is none to learn from.
    """
    from roboxim_core.errors import ConfigError
    from roboxim_eval.experiments.allocation import allocated, allocation_of
    from roboxim_eval.experiments.cost import fitted
    from roboxim_runs.experiments.files import trainer_name
    from roboxim_runs.experiments.plan import allocation_lines, earlier_components, hours

    chosen, lines = trainer_name(config, trainer), []
    if cards:
        parts = earlier_components(cards)
        one = allocated(config, rates, parts, seconds, chosen, trainings)
        sized = None if one is None else one.config
        if one is not None:
            lines = list(
                allocation_lines(name, one, allocation_of(config, rates, parts, chosen, trainings), len(cards))
            )
    else:
        sized = fitted(config, rates, seconds, chosen, trainings)
    if sized is None:
        raise ConfigError(f"no size of '{name}' takes less than {hours(seconds)}; a training alone may take longer")
    return sized, lines


def _at_once(name: str, config: ExperimentConfig, trainer: str, trainings: int) -> int:
    """Return how many trainings of an experiment run at a time if at most a number of them may."""
    from roboxim_eval.experiments.cost import trainings_at_once
    from roboxim_runs.experiments.files import checked_design

    return 1 if trainings == 1 else trainings_at_once(checked_design(name, config, trainer), trainings)


def duration_s(text: str) -> float:
    """Return a duration given as e.g. ``8h``, ``90min`` or ``45 min`` [s].

    Raises:
        ConfigError: When the text is no duration.
    """
    import re

    from roboxim_core.errors import ConfigError

    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(h|min|s|d)\s*", text)
    if not found or not float(found[1]):
        raise ConfigError(f"expected a duration such as 8h, 90min or 2d, got '{text}'")
    return float(found[1]) * {"s": 1, "min": 60, "h": 3600, "d": 86400}[found[2]]
