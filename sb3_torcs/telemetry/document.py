"""HTML documents in one file: styles, scripts and Plotly inside, so that they work offline."""

from __future__ import annotations

import base64
import functools
import gzip
import json
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from sb3_torcs.errors import needs_extra
from sb3_torcs.files import atomic_file

__all__ = [
    "FOLDER",
    "Cell",
    "chip",
    "colour_of",
    "dash_of",
    "document",
    "paragraph",
    "table",
    "write_document",
]

FOLDER = Path(__file__).parent

LONG = 60  # rows; a table with more scrolls on the screen

OKABE_ITO = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""Colours that colour-blind people tell apart; without the yellow, which is weak on white."""

DASHES = ("solid", "dash", "dot")
"""Lines of those who have the colours first, of those who have them again, and so on."""

PAGE = """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>
{style}</style>
</head>
<body>
{body}
<script type="application/json" id="data">{data}</script>
<script type="text/plain" id="plotly">{plotly}</script>
<script>
{scripts}</script>
</body>
</html>
"""


class Cell(NamedTuple):
    """A cell of a table."""

    text: str
    sort: float | None = None  # what the column is sorted by, instead of the text
    html: str = ""  # instead of the text
    best: bool = False


def document(title: str, body: str, data: Any, scripts: Sequence[str]) -> str:
    """
    Put a page together.

    :param title: of the page
    :param body: HTML
    :param data: what the scripts read, of plain Python types
    :param scripts: names of files beside this one
    :return: the whole page, which needs no other file and no network
    :raises PackageMissing: if Plotly is not installed
    """
    return PAGE.format(
        title=escape(title),
        style=_text("page.css"),
        body=body,
        # In a script, "</" could end it.
        data=json.dumps(data, separators=(",", ":"), allow_nan=False).replace("</", "<\\/"),
        plotly=_packed_plotly(),
        scripts="".join(_text(name) for name in ("page_plotly.js", *scripts)),
    )


def _text(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")


@functools.cache
def _packed_plotly() -> str:
    """Return Plotly's own bundle, compressed; the same at each call."""
    with needs_extra("the report"):
        from plotly.offline import get_plotlyjs
    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode()


def write_document(path: Path, text: str) -> None:
    """
    Write a page.

    :param path: of the file, which appears when it is complete
    :param text: of the page
    :raises OutputNotWritable: if the file cannot be written
    """
    with atomic_file(path) as aside:
        aside.write_text(text, encoding="utf-8")


def colour_of(number: int) -> str:
    """
    Choose a colour.

    :param number: of what has it, from 0; colours come again after seven
    """
    return OKABE_ITO[number % len(OKABE_ITO)]


def dash_of(number: int) -> str:
    """
    Choose how a line is drawn, as Plotly calls it.

    :param number: of what has it, from 0; colour and dash together come again after 21
    """
    return DASHES[number // len(OKABE_ITO) % len(DASHES)]


def chip(number: int) -> str:
    """
    Return a dot, or a stroke if its line is not solid, in the colour of something, as HTML.

    :param number: of what it stands for
    """
    return f'<span class="chip {dash_of(number)}" style="--colour:{colour_of(number)}"></span>'


def paragraph(text: str, kind: str = "") -> str:
    """
    Return a paragraph as HTML.

    :param text: plain text
    :param kind: its class in ``page.css``
    """
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def table(
    headers: Sequence[str],
    groups: Sequence[Sequence[Sequence[Cell | str]]],
    *,
    words: int = 1,
    kind: str = "",
) -> str:
    """
    Return a table as HTML.

    :param headers: of the columns
    :param groups: of rows of cells
    :param words: how many of the first columns hold words and stand to the left
    :param kind: class of the table; ``"sortable"`` lets a click on a header sort it
    """

    def cell(tag: str, place: int, content: Cell | str) -> str:
        item = Cell(content) if isinstance(content, str) else content
        names = [*(["word"] if place < words else []), *(["best"] if item.best else [])]
        marks = f' class="{" ".join(names)}"' if names else ""
        marks += "" if item.sort is None else f' data-sort="{item.sort!r}"'
        return f"<{tag}{marks}>{item.html or escape(item.text)}</{tag}>"

    def row(tag: str, cells: Sequence[Cell | str]) -> str:
        return f"<tr>{''.join(cell(tag, place, c) for place, c in enumerate(cells))}</tr>"

    opening = "<tbody>" if len(groups) == 1 else '<tbody class="group" tabindex="0">'
    bodies = "".join(f"{opening}{''.join(row('td', r) for r in rows)}</tbody>" for rows in groups)
    head = f"<thead>{row('th', list(headers))}</thead>"
    frame = "scroll long" if sum(map(len, groups)) > LONG else "scroll"
    return f'<div class="{frame}"><table class="{kind}">{head}{bodies}</table></div>'
