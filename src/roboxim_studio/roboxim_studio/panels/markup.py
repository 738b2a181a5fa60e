"""HTML of the panels. Everything that comes from data is escaped: it is text, never markup."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence

from roboxim_studio.episode.judgement import Lamp

STYLE = "font-size:13px;line-height:1.4;overflow-wrap:anywhere;padding:2px 10px;max-width:100%;box-sizing:border-box"
GREEN, RED, GREY = "#2f9e44", "#e03131", "#868e96"


def escaped(value: object) -> str:
    """Return a value as HTML text."""
    return html.escape(str(value), quote=True)


def block(content: str, element_id: str = "") -> str:
    """Return HTML in the panel's style.

    Args:
        content: HTML whose data is already escaped.
        element_id: Id of the block, by which tests and scripts find it.
    """
    return f'<div{f" id={chr(34)}{escaped(element_id)}{chr(34)}" if element_id else ""} style="{STYLE}">{content}</div>'


def paragraph(text: str, element_id: str = "", *, alert: bool = False) -> str:
    """Return a text as a block; lines stay lines."""
    colour = f"color:{RED};" if alert and text else ""
    return block(f'<span style="{colour}white-space:pre-line">{escaped(text)}</span>', element_id)


def facts(rows: Iterable[tuple[str, object]], element_id: str = "") -> str:
    """Return names and values as a table."""
    lines = "".join(
        f'<tr><td style="color:{GREY};padding-right:10px;vertical-align:top;white-space:nowrap">{escaped(name)}</td>'
        f"<td>{escaped(value)}</td></tr>"
        for name, value in rows
    )
    return block(f'<table style="border-spacing:0">{lines}</table>', element_id)


def number(value: float) -> str:
    """Return a measure's value for reading."""
    return "-" if math.isnan(value) else f"{value:.4g}" if abs(value) >= 1e-3 or value == 0 else f"{value:.1e}"


def lamps(shown: Sequence[Lamp], element_id: str = "conditions") -> str:
    """Return conditions with their lamps, measures and bounds."""
    lines = "".join(
        f'<tr data-condition="{escaped(lamp.name)}" data-holds="{int(lamp.holds)}">'
        f'<td style="color:{GREEN if lamp.holds else RED}">{"&#9679;" if lamp.holds else "&#9675;"}</td>'
        f'<td style="padding-right:8px">{escaped(lamp.name)}{" *" if lamp.fatal else ""}</td>'
        f'<td style="padding-right:8px;color:{GREY}">{escaped(lamp.measure)}</td>'
        f'<td style="text-align:right;padding-right:8px">{number(lamp.value)}</td>'
        f'<td style="color:{GREY};white-space:nowrap">{escaped(lamp.bounds)}</td></tr>'
        for lamp in shown
    )
    note = f'<div style="color:{GREY};font-size:12px">* final: once broken, the task cannot be solved any more</div>'
    return block(f'<table style="border-spacing:0 1px;font-size:12px">{lines}</table>{note}', element_id)


def pre(text: str, element_id: str = "") -> str:
    """Return a text in a fixed pitch, e.g. YAML."""
    return block(
        f'<pre style="font-size:11px;line-height:1.35;white-space:pre-wrap;margin:0;max-height:320px;overflow-y:auto">'
        f"{escaped(text)}</pre>",
        element_id,
    )
