"""The frame of every HTML page that a run writes: one style, no links outside."""

from io import StringIO
from pathlib import Path
from typing import Any


def html_page(title: str, body: str, style: str = "", after: str = "") -> str:
    """A self-contained page.

    Args:
        title, body: HTML, escaped where needed; the body stands in <main>.
        style: CSS besides report.css.
        after: HTML behind <main>, such as dialogs and scripts.
    """
    css = Path(__file__).with_name("report.css").read_text()
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta name="color-scheme" content="light dark"><style>\n{css}{style}</style></head>\n<body><main>'
        f"{body}</main>{after}</body></html>\n"
    )


def figure_svg(figure: Any) -> str:
    """A matplotlib Figure as inline SVG."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer = StringIO()
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
