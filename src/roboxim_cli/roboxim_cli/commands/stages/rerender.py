"""Render recorded episodes again: other cameras, lights, textures, resolution, renderer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from roboxim_cli import strict
from roboxim_cli.options import option
from roboxim_core.errors import counted

if TYPE_CHECKING:
    from roboxim_core.specs import LookSpec
    from roboxim_core.vision.looks import Lighting


@strict.command(begins="rendering")
@click.argument("sources", type=click.Path(exists=True, path_type=Path), nargs=-1, required=True)
@option("out", required=True, help="Folder of the new run.")
@option("renderer", help="raster, tiny, or photo (Blender; make photo installs it).")
@option("camera", help="Camera to render: a recorded one, or the pose of a file; may be repeated. Default: all.")
@option("size", help="Image size of every camera.")
@click.option("--depth/--no-depth", default=None, help="Also record depth. Default: as each camera is configured.")
@click.option("--segmentation/--no-segmentation", default=None, help="Also record segmentation.")
@option("light", metavar="NAME|YAML", help="Lighting: a name in config/lights, a YAML file, or one light as YAML.")
@option("texture", help="Texture of table, floor or wall, e.g. table=marble; an empty NAME removes it.")
@click.option(
    "--background", type=click.Choice(["room", "plain"]), help="Surroundings: a room with walls, or a plain colour."
)
@option("look", metavar="SET/LOOK|SCENE", help="Use a look of a set, e.g. varied/oak_daylight, or that of a scene.")
@option("workers", default=1, help="Number of processes, each with a renderer.")
def command(
    sources: tuple[Path, ...], out: Path, renderer: str, cameras: tuple[str, ...], size: str,
    depth: bool | None, segmentation: bool | None, lights: tuple[str, ...], textures: tuple[str, ...],
    background: str | None, look: str, workers: int,
) -> None:  # fmt: skip
    r"""Render bags again into OUT/episodes: the same episodes, states and actions, with other images.

    \b
    roboxim rerender runs/demos --out runs/demos-evening --light evening --texture table=marble
    roboxim rerender runs/demos --out runs/demos-left --camera workspace=workspace_left --camera wrist
    roboxim rerender runs/demos/episodes/demo-0-00000-0 --out runs/photo --renderer photo --size 512

    SOURCES are bags, folders of bags or runs. No running graph is needed. Unchanged settings give the recorded images,
    bit for bit on one type of machine. Ctrl-C stops; the same command continues with the missing bags.
    """
    from roboxim_cli.options import parse_size
    from roboxim_cli.printer import EventPrinter
    from roboxim_core.errors import ConfigError
    from roboxim_core.plain_data.pictures import texture_name
    from roboxim_runs.episodes.pictures import write_contact_sheet
    from roboxim_runs.episodes.rerendering import RerenderConfig, find_bags, rerender
    from roboxim_runs.episodes.task_choice import camera_words
    from roboxim_runs.storage.folder import path_as_given

    bags, out = find_bags(sources), path_as_given(out)
    for word in textures:
        if "=" not in word:
            raise ConfigError(f"--texture is SURFACE=NAME, e.g. table=marble, got '{word}'")
    width, height = parse_size(size)
    lighting = _lighting(lights)
    config = RerenderConfig(
        renderer=renderer, cameras=camera_words(cameras),
        width=width, height=height, depth=depth, segmentation=segmentation,
        look=_look(look) if look else None,
        lights=lighting.lights if lighting else None, ambient=lighting.ambient if lighting else None,
        textures={
            surface: texture_name(name, Path.cwd())
            for surface, _, name in (word.partition("=") for word in textures)
        },
        background=background or "",
    )  # fmt: skip
    with EventPrinter() as printer:
        report = rerender(bags, out, config, workers=workers, on_event=printer)
    there = f" ({report.there} were there)" if report.there else ""
    made = counted(report.made, "episode")
    click.echo(
        f"{made} rendered with '{renderer}' into {out / 'episodes'}{there}"
        if report.made
        else f"all {report.there} episodes are in {out / 'episodes'} already; nothing to do"
    )
    if report.changed:
        click.echo(
            "note: these models have changed since the recording and are drawn as they are now: "
            + ", ".join(report.changed)
        )
    first = next(iter(sorted((out / "episodes").iterdir())), None)
    if first is not None:
        picture = out / "first_episode.png"
        if write_contact_sheet([first], picture):
            click.echo(f"a picture: {picture}")


def _look(name: str) -> LookSpec:
    """Return a look of a set, ``SET/LOOK``, or the look of a scene."""
    from roboxim_core.config_folders import config_names, named_config
    from roboxim_core.errors import ConfigError, one_of
    from roboxim_core.plain_data.pictures import load_scenery
    from roboxim_core.specs import SceneSpec
    from roboxim_core.vision.looks import LookSet

    looks, slash, one = name.partition("/")
    if not slash or looks not in config_names("looks"):
        return load_scenery(named_config("scenes", name), SceneSpec).look
    found = load_scenery(named_config("looks", looks), LookSet).looks
    if one not in found:
        raise ConfigError(f"set '{looks}' has no look '{one}'; {one_of(found, one)}")
    return found[one].look


def _lighting(words: tuple[str, ...]) -> Lighting | None:
    """Return the lights that the options name; none: the recorded ones."""
    from roboxim_core.config import from_plain, load_config, named_config, parse_yaml
    from roboxim_core.specs import LightSpec
    from roboxim_core.vision.looks import Lighting

    if not words:
        return None
    lights: list[LightSpec] = []
    ambient = None
    for word in words:
        if word.lstrip().startswith("{"):
            lights.append(from_plain(parse_yaml(word, source="--light"), LightSpec, source="--light"))
        else:
            preset = load_config(named_config("lights", word), Lighting)
            lights += preset.lights
            ambient = preset.ambient or ambient
    return Lighting(lights=tuple(lights), ambient=ambient)
