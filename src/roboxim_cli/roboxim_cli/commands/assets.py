"""Draw the objects on one contact sheet; import, check, draft or simplify your own."""

from __future__ import annotations

from pathlib import Path

import click

from roboxim_cli import strict
from roboxim_cli.named import Named
from roboxim_cli.options import option, parse_side, require_ending


@strict.group()
def command() -> None:
    """Draw the objects on one contact sheet; import, check, draft or simplify your own."""


@command.command("sheet", begins="drawing objects")
@click.argument("objects", type=Named("object"), nargs=-1)
@option("out", default="sheet.png", help="File of the picture.")
@option("renderer", name="renderer_name")
@option("size", default="256", metavar="PX", help="Side of each picture.")
@click.option("--columns", default=5, show_default=True, type=click.IntRange(1, 1000), help="Pictures in a row.")
@click.option("--labels/--no-labels", default=True, show_default=True, help="Names under the pictures.")
@click.option(
    "--shuffle", type=click.IntRange(0), help="Seed of a random order, for a blind test; the order is printed."
)
@click.option("--variants", is_flag=True, help="Also draw each colour, material and size.")
def sheet(
    objects: tuple[str, ...],
    out: Path,
    renderer_name: str,
    size: str,
    columns: int,
    labels: bool,
    shuffle: int | None,
    variants: bool,
) -> None:
    r"""Draw OBJECTS (default: all but those of sets) on one contact sheet in the default look.

    \b
    roboxim assets sheet
    roboxim assets sheet shapes --columns 10 --size 128
    roboxim assets sheet mug bowl --variants --out variants.png
    roboxim assets sheet --no-labels --shuffle 7 --out blind.png
    """
    import numpy as np

    from roboxim_core.config import digest
    from roboxim_core.models.library import ModelLibrary
    from roboxim_core.specs import EntitySpec, LookSpec, Scalar
    from roboxim_runs.assets.sheet import contact_sheet, draw_object
    from roboxim_sim.rendering import make_renderer

    require_ending(out, ".png", ".jpg", ".jpeg")
    library = ModelLibrary()
    entities, texts = [], []
    for object_id in library.expanded(objects) or library.object_ids:
        given: list[dict[str, Scalar]] = [{}]
        for kind, modifier in library.object_modifiers(object_id).items() if variants else ():
            if words := modifier.words(kind) if kind in ("color", "material", "size") else ():
                given += [{kind: word} for word in words if word != modifier.default]
        for modifiers in given:
            entities.append(EntitySpec(name=object_id, model=object_id, modifiers=modifiers))
            texts.append(" ".join([*map(str, modifiers.values()), object_id]))
    if shuffle is not None:
        order = np.random.default_rng(shuffle).permutation(len(entities))
        entities, texts = [entities[k] for k in order], [texts[k] for k in order]
        click.echo("\n".join(f"{k + 1}: {text}" for k, text in enumerate(texts)))
    renderer = make_renderer(renderer_name)
    try:
        pictures = [draw_object(renderer, library, entity, parse_side(size)) for entity in entities]
    finally:
        renderer.close()
    picture = contact_sheet(pictures, texts if labels else None, columns)
    out.parent.mkdir(parents=True, exist_ok=True)
    picture.save(out, optimize=True, quality=90)
    click.echo(
        f"wrote {out}: {len(pictures)} pictures, drawn by {renderer_name} on {renderer.device}, "
        f"look {digest(LookSpec())}"
    )


@command.command("check", begins="checking objects")
@click.argument("targets", nargs=-1, required=True)
def check(targets: tuple[str, ...]) -> None:
    r"""Check objects, given as ids, sets or paths of YAML files. The exit code is 1 when an object has errors.

    \b
    roboxim assets check mug
    roboxim assets check my_objects/objects/teapot.yaml
    """
    from roboxim_core.errors import ErrorCode, RoboximError
    from roboxim_core.models.library import ModelLibrary
    from roboxim_runs.assets.check import check as check_one

    library, errors = ModelLibrary(), 0
    targets = library.expanded(targets)
    for target in targets:
        found = check_one(target, library)
        errors += any(finding.severity == "error" for finding in found)
        click.echo(f"{target}: {'good' if not found else ''}".rstrip())
        for finding in found:
            click.echo(f"  {finding.severity}: {finding.message}")
    if errors:
        raise RoboximError(f"{errors} of {len(targets)} objects cannot be used as they are", ErrorCode.INVALID_CONFIG)


@command.command("import", begins="importing")
@click.argument("meshes", nargs=-1, required=True, type=click.Path(exists=True, dir_okay=False, path_type=Path))
@option("out", default="my_objects", help="Configuration folder; the objects are written into its folder objects/.")
@click.option("--unit", default="", metavar="m|cm|mm|in", help="Unit of the files; default: guessed and printed.")
@click.option("--up", default="z", show_default=True, type=click.Choice(["z", "y"]), help="Axis that points up.")
@click.option("--mass", type=click.FloatRange(0, 20, min_open=True), metavar="KG", help="Mass; default: guessed.")
@click.option("--noun", default="", help="Noun in instructions; default: the file's name.")
@click.option(
    "--gripper", type=Named("gripper"), default="franka_hand", show_default=True, help="Gripper that shall grasp it."
)
@click.option("--thorough", is_flag=True, help="Cut into finer convex parts: minutes a mesh instead of seconds.")
@click.option("--again", is_flag=True, help="Also import objects that are already in the folder.")
def import_(
    meshes: tuple[Path, ...],
    out: Path,
    unit: str,
    up: str,
    mass: float | None,
    noun: str,
    gripper: str,
    thorough: bool,
    again: bool,
) -> None:
    r"""Make objects of MESHES (GLB, OBJ, STL, ...): collision shapes, mass, rest poses, affordances, proven grasps.

    \b
    roboxim assets import teapot.glb
    roboxim assets import scans/*.obj --unit mm --up y --out my_things

    Each grasp has lifted the object in a floating gripper. Guesses are printed and written into the YAML file.
    """
    from roboxim_cli.progress import ProgressLine
    from roboxim_core.errors import ConfigError, ErrorCode, RoboximError
    from roboxim_runs.assets.importing import ImportOptions, import_mesh, object_id_of

    if noun and len(meshes) > 1:
        raise ConfigError("--noun names one object: give one mesh")
    options = ImportOptions(
        unit=unit, up=up, mass_kg=mass or 0.0, name=noun, gripper=gripper, effort="thorough" if thorough else "fast"
    )
    names, failed = [], 0
    with ProgressLine("importing", len(meshes), unit="meshes") as line:
        for number, mesh in enumerate(meshes):
            object_id = object_id_of(mesh)
            if not again and (out / "objects" / f"{object_id}.yaml").is_file():
                line.say(f"{object_id}: exists; --again imports it again")
                names.append(object_id)
                continue
            line.update(number, object_id)
            try:
                made = import_mesh(
                    mesh, out / "objects", options,
                    on_step=lambda step, n=number, o=object_id: line.update(n, f"{o}: {step}"),  # type: ignore[misc]
                )  # fmt: skip
            except RoboximError as error:
                failed += 1
                line.say(f"{object_id}: not imported: {error}")
                continue
            names.append(object_id)
            line.say("\n  ".join([f"{object_id}: {made.file}", *made.report]))
            line.update(number + 1)
    if names:
        click.echo(f"use: export ROBOXIM_CONFIG_PATH={out}")
        click.echo(f"see: roboxim assets sheet {' '.join(names[:5])}")
    if failed:
        raise RoboximError(f"{failed} of {len(meshes)} meshes were not imported", ErrorCode.INVALID_CONFIG)


@command.command("new", begins="making the object")
@click.argument("mesh", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--unit", default="", metavar="m|cm|mm|in", help="Unit of the file; default: the one that fits a table.")
@click.option("--up", default="", metavar="z|y", help="Axis of the file that points up; y writes a turned copy.")
def new(mesh: Path, unit: str, up: str) -> None:
    r"""Print a draft YAML file for your MESH (GLB, OBJ, STL, ...); save it beside the mesh.

    \b
    roboxim assets new teapot.glb > teapot.yaml
    roboxim assets new teapot.stl --unit mm --up y > teapot.yaml

    In a terminal the command prompts for unit and axis; otherwise it prints the resulting size on the error stream.
    """
    import sys

    from roboxim_runs.assets.check import guessed_unit, size_text, starter
    from roboxim_runs.assets.solids import UPS

    guess = unit or guessed_unit(mesh)
    if sys.stdin.isatty() and not (unit and up):
        for axis in UPS:
            click.echo(f"{mesh.name} with {size_text(mesh, guess, axis)}", err=True)
        guess = unit or click.prompt("unit", default=guess, err=True)
        up = up or click.prompt("axis that points up", default="z", err=True)
    else:
        click.echo(f"{mesh.name}: {size_text(mesh, guess, up or 'z')}; else give --unit and --up", err=True)
    click.echo(starter(mesh, guess, up or "z"), nl=False)


@command.command("simplify", begins="simplifying")
@click.argument("mesh", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "--triangles", default=1500, show_default=True, type=click.IntRange(20), help="Approximate number of triangles."
)
@option("out", help="File of the copy; default: MESH_simple.glb.")
def simplify(mesh: Path, triangles: int, out: Path | None) -> None:
    """Write a copy of MESH with fewer triangles and the same materials."""
    from roboxim_runs.assets.check import simplify as simplified

    target = out or mesh.with_name(f"{mesh.stem}_simple.glb")
    before, after = simplified(mesh, triangles, target)
    click.echo(f"wrote {target}: {after} of {before} triangles")
