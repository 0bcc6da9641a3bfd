"""The page of a report: one HTML file that needs nothing but itself."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape

from pixel2catch.identification.report_figures import COLORS
from pixel2catch.identification.report_tables import Cell, Grid

STYLE = """
body { font: 14px/1.45 system-ui, sans-serif; color: #1c1c1c; margin: 2rem auto; padding: 0 1rem;
  max-width: 72rem }
h1 { font-size: 1.7rem; margin-bottom: .2rem }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .4rem }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem }
p { margin: .4rem 0; max-width: 60rem }
ul { margin: .3rem 0; padding-left: 1.2rem }
.scroll { overflow-x: auto }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
th { text-align: left; vertical-align: bottom; border-bottom: 1.5px solid #1c1c1c }
td { vertical-align: top; border-bottom: 1px solid #e4e4e4 }
th, td { padding: .25rem 1.1rem .25rem 0 }
td:first-child { white-space: nowrap }
small { display: block; color: #6a6a6a; font-weight: 400 }
.good { color: #17703f } .weak { color: #9a5b00 } .unknown { color: #6a6a6a }
.BAD { color: #b3261e; font-weight: 600 }
.box { border-left: 4px solid; padding: .5rem .9rem; margin: .7rem 0; background: #f6f6f6 }
.box p { color: #1c1c1c }
.key span { display: inline-block; width: 1.6rem; height: 3px; margin: 0 .4rem .25rem 1.1rem }
figure { margin: .8rem 0; break-inside: avoid }
figcaption { font-weight: 600 }
img { width: 100%; display: block }
code { background: #f2f2f2; padding: .1rem .3rem; overflow-wrap: anywhere }
@page { size: A4; margin: 14mm }
@media print {
  body { margin: 0; max-width: none; font-size: 10px; print-color-adjust: exact }
  tr, .box { break-inside: avoid }
  h2, h3 { break-after: avoid }
  .scroll { overflow: visible }
  th, td { padding-right: .5rem }
}
"""
"""Look of the page, on a screen and on paper."""


def page(title: str, parts: Iterable[str]) -> str:
    """Compose the page.

    Args:
        title: What it is about.
        parts: Its content, in HTML.
    """
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><style>{STYLE}</style>'
    body = "\n".join(parts)
    return f'<!DOCTYPE html>\n<html lang="en">\n<head>{head}</head>\n<body>\n{body}\n</body>\n</html>\n'


def heading(text: str, level: int = 2) -> str:
    """A heading."""
    return f"<h{level}>{escape(text)}</h{level}>"


def paragraph(text: str) -> str:
    """A paragraph."""
    return f"<p>{escape(text)}</p>"


def code(text: str) -> str:
    """A paragraph of code."""
    return f"<p><code>{escape(text)}</code></p>"


def listing(texts: Sequence[str]) -> str:
    """A list, if there is anything to list."""
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f"<ul>{items}</ul>" if texts else ""


def box(verdict: str, text: str) -> str:
    """What a reader must not miss, in the colour of a verdict."""
    return f'<div class="box {verdict}">{paragraph(text)}</div>'


def table(grid: Grid) -> str:
    """A table, without its title."""
    head = "".join(f"<th>{escape(column)}</th>" for column in grid.columns)
    rows = "".join(f"<tr>{''.join(map(_cell, row))}</tr>\n" for row in grid.rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n<tbody>{rows}</tbody></table></div>'


def pictures(images: Mapping[str, bytes]) -> str:
    """PNG files by caption, within the page."""
    return "\n".join(
        f'<figure><figcaption>{escape(caption)}</figcaption><img alt="{escape(caption)}" '
        f'src="data:image/png;base64,{base64.b64encode(image).decode()}"></figure>'
        for caption, image in images.items()
    )


def color_key() -> str:
    """What the colours of the pictures mean."""
    lines = "".join(f'<span style="background: {color}"></span>{name}' for name, color in COLORS.items())
    return f'<p class="key">{lines}</p>'


def _cell(cell: Cell) -> str:
    note = f"<small>{escape(cell.note)}</small>" if cell.note else ""
    kind = f' class="{cell.verdict}"' if cell.verdict else ""
    return f"<td{kind}>{escape(cell.text)}{note}</td>"
