"""Pages: templates to self-contained HTML that opens offline, on a phone and in the dark."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from roboxim_eval.report.charts.forest import forest_axis, forest_bar, rate_bar
from roboxim_eval.report.parts import by_task

if TYPE_CHECKING:
    from jinja2 import Environment


def render(template: str, **values: Any) -> str:
    """Return a page.

    Args:
        template: Name of a template of this package.
        values: Values of the template; all texts are escaped.
    """
    return _environment().get_template(template).render(**values)


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("roboxim_eval", "templates"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["percent"] = lambda value: f"{100 * value:.0f} %"
    environment.globals |= {
        "forest_bar": forest_bar,
        "forest_axis": forest_axis,
        "rate_bar": rate_bar,
        "by_task": by_task,
    }
    return environment
