"""A self-contained page: one style for all reports, all text escaped, nothing loaded from elsewhere.

It has no scripts. It is readable on a phone, on paper, and with light and dark colour schemes. Colours are
the style's variables ``--series-0`` to ``--series-7``, so that one drawing fits all of them.
"""

from collections.abc import Iterable, Mapping, Sequence
from html import escape

SERIES = 8
"""Number of distinct colours of series; further series use them again from the first."""

CONTENT_POLICY = (
    '<meta http-equiv="Content-Security-Policy" content="'
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
    '">'
)
"""Element of a page's head: the browser runs no script of the page, and loads nothing but pictures in it."""

_STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1d2327; --soft: #5d6770; --line: #d5dbe0;
  --card: #f5f7f8; --bad: #b3261e;
  --series-0: #0072b2; --series-1: #d55e00; --series-2: #009e73; --series-3: #a85c90;
  --series-4: #b8860b; --series-5: #2f9fd0; --series-6: #5a4fcf; --series-7: #6b6b6b; }
@media (prefers-color-scheme: dark) { :root { --paper: #14181b; --ink: #e4e8ea; --soft: #9aa5ad;
  --line: #39424a; --card: #1d2327; --bad: #ff8a80;
  --series-0: #56a9e8; --series-1: #ff9557; --series-2: #35c79b; --series-3: #d996c4;
  --series-4: #e3b341; --series-5: #8fd3f4; --series-6: #a59cff; --series-7: #b0b0b0; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 72rem; padding: 1rem; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, sans-serif; overflow-wrap: anywhere; }
h1 { font-size: 1.5rem; margin: .5rem 0 0; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
h3 { font-size: 1rem; margin: 0; } p { margin: .25rem 0; max-width: 48rem; }
.soft, figcaption p { color: var(--soft); font-size: .875rem; }
.figures { display: grid; gap: 1rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 26rem), 1fr)); }
figure { margin: 0; padding: .75rem; background: var(--card); border-radius: .5rem; min-width: 0; }
figure.wide { grid-column: 1 / -1; }
svg { display: block; width: 100%; height: auto; }
svg text { fill: var(--soft); font: 11px system-ui, sans-serif; }
svg .grid { stroke: var(--line); stroke-width: 1; fill: none; }
svg .curve { fill: none; stroke-width: 1.6; stroke-linejoin: round; stroke-linecap: round; }
svg .dashed { stroke-dasharray: 5 3; } svg .band { stroke: none; opacity: .2; } svg .area { stroke: none; }
.legend { display: flex; flex-wrap: wrap; gap: .1rem 1rem; font-size: .8125rem; }
.legend span::before { content: ""; display: inline-block; width: .8em; height: .8em; margin-right: .4em;
  border-radius: .2em; background: var(--key); }
.tiles { display: grid; gap: .5rem; grid-template-columns: repeat(auto-fill, minmax(8.5rem, 1fr)); }
.tiles div { background: var(--card); border-radius: .5rem; padding: .5rem .75rem; }
.tiles b { display: block; font-size: 1.15rem; } .tiles span { color: var(--soft); font-size: .8125rem; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; font-size: .875rem; }
th, td { text-align: left; padding: .2rem .75rem .2rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
pre { background: var(--card); padding: .75rem; border-radius: .5rem; overflow-x: auto; font-size: .8125rem;
  white-space: pre-wrap; }
ul { padding-left: 1.2rem; margin: .25rem 0; } .bad { color: var(--bad); }
@media (max-width: 40rem) { figure.wide svg text { font-size: 16px; } }
@media print { :root { color-scheme: light; --paper: #fff; --ink: #000; --soft: #444; --line: #ccc;
  --card: #fff; --bad: #900;
  --series-0: #0072b2; --series-1: #d55e00; --series-2: #009e73; --series-3: #a85c90;
  --series-4: #b8860b; --series-5: #2f9fd0; --series-6: #5a4fcf; --series-7: #6b6b6b; }
  body { max-width: none; padding: 0; font-size: 10pt; } figure, .tiles div { border: 1px solid var(--line); }
  .figures { grid-template-columns: 1fr 1fr; } figure, tr, .tiles div { break-inside: avoid; }
  h2 { break-after: avoid; } pre { font-size: 7.5pt; } details::details-content { content-visibility: visible;
  block-size: auto; } }
"""


def page(title: str, sections: Iterable[str]) -> str:
    """Return a whole HTML document; sections are HTML of the functions below, the title is plain text."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        # the browser asks the server for no icon
        f'<link rel="icon" href="data:,">{CONTENT_POLICY}'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head>\n<body>\n<h1>{escape(title)}</h1>\n"
        + "\n".join(part for part in sections if part)
        + "\n</body></html>\n"
    )


def section(title: str, *parts: str) -> str:
    """Return a titled section; return "" if all parts are empty."""
    body = "\n".join(part for part in parts if part)
    return f"<section><h2>{escape(title)}</h2>\n{body}\n</section>" if body else ""


def figures(*drawn: str) -> str:
    """Place figures side by side, as many as the width allows."""
    body = "\n".join(figure for figure in drawn if figure)
    return f'<div class="figures">\n{body}\n</div>' if body else ""


def figure(
    title: str, svg: str, caption: str = "", legend: Sequence[tuple[str, int]] = (), wide: bool = False
) -> str:
    """Return a drawing with its title.

    Args:
        title: plain text.
        svg: the drawing, HTML.
        caption: what the drawing shows, plain text.
        legend: names, each with the number of its colour.
        wide: whether it takes the whole width.
    """
    keys = "".join(
        f'<span style="--key: {series_colour(number)}">{escape(name)}</span>' for name, number in legend
    )
    return (
        f"<figure{' class=wide' if wide else ''}><figcaption><h3>{escape(title)}</h3>"
        f"{paragraph(caption)}</figcaption>{svg}"
        + (f'<div class="legend">{keys}</div>' if keys else "")
        + "</figure>"
    )


def series_colour(number: int) -> str:
    """Return the colour of a series as CSS."""
    return f"var(--series-{number % SERIES})"


def paragraph(text: str, soft: bool = False) -> str:
    """Return a paragraph of plain text; return "" for an empty text."""
    return f"<p{' class=soft' if soft else ''}>{escape(text)}</p>" if text else ""


def bullets(sentences: Iterable[str], bad: bool = False) -> str:
    """Return a list of plain sentences; return "" for none."""
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)
    return f"<ul{' class=bad' if bad else ''}>{items}</ul>" if items else ""


def tiles(values: Mapping[str, str]) -> str:
    """Return the most important numbers, each above its name."""
    cells = "".join(
        f"<div><b>{escape(value)}</b><span>{escape(name)}</span></div>" for name, value in values.items()
    )
    return f'<div class="tiles">{cells}</div>' if cells else ""


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of plain text; cells that begin with a number are aligned right."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def folded(title: str, text: str) -> str:
    """Return long plain text that opens on a click and is always open on paper."""
    return f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>" if text else ""


def _cell(text: str) -> str:
    try:
        float(text.split()[0])
    except (ValueError, IndexError):
        return f"<td>{escape(text)}</td>"
    return f"<td class=number>{escape(text)}</td>"
