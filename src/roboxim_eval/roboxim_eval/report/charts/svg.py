"""SVG elements as text. Values are escaped; classes name colours of the page's style, so that dark mode applies."""

from __future__ import annotations

from collections.abc import Iterable

from markupsafe import Markup, escape


def element(name: str, content: Iterable[Markup] | str = "", /, **attributes: object) -> Markup:
    """Return an element.

    Args:
        name: Its name.
        content: Elements inside, or its text.
        attributes: Attributes; ``_`` in a name stands for ``-``, a trailing one is dropped (``class_``); None: left
            out; numbers are written with two decimals at most.
    """
    written = Markup("").join(
        Markup(' {}="{}"').format(key.rstrip("_").replace("_", "-"), _text(value))
        for key, value in attributes.items()
        if value is not None
    )
    inner = escape(content) if isinstance(content, str) else Markup("").join(content)
    if not inner:
        return Markup("<{}{}/>").format(Markup(name), written)
    return Markup("<{}{}>{}</{}>").format(Markup(name), written, inner, Markup(name))


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.2f}".rstrip("0").rstrip(".") or "0"
    return str(value)


def drawing(content: Iterable[Markup], *, width: float, height: float, label: str, class_: str = "chart") -> Markup:
    """Return an SVG picture with a size of its own; a page shrinks it to its width.

    Args:
        content: Elements.
        width: Width [px].
        height: Height [px].
        label: Description for screen readers.
        class_: Class in the page's style.
    """
    return element(
        "svg", content, viewBox=f"0 0 {width:g} {height:g}", width=width, height=height, role="img",
        aria_label=label, class_=class_,
    )  # fmt: skip


def link(content: Iterable[Markup], href: str) -> Markup:
    """Return elements with a link to another place of the page."""
    return element("a", content, href=href)
