"""Print a shell's completion script."""

from __future__ import annotations

import click

from roboxim_cli import strict


@strict.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def command(shell: str) -> None:
    r"""Print a shell's completion script.

    \b
    bash: eval "$(roboxim completion bash)"
    zsh:  eval "$(roboxim completion zsh)"
    fish: roboxim completion fish | source
    """
    from click.shell_completion import get_completion_class

    from roboxim_cli.main import group

    cls = get_completion_class(shell)
    if cls is None:
        raise click.ClickException(f"click knows no completion for {shell}")
    click.echo(_script(cls, group))


def _script(cls: type, group: click.Command) -> str:
    completion = cls(group, {}, "roboxim", "_ROBOXIM_COMPLETE")
    source: str = completion.source_template % completion.source_vars()
    return source  # not .source(), which runs bash just to learn its version
