"""One HTML file that holds a whole report, and its JSON twin.

The page needs no network, runs no script and fetches nothing: pictures and style are inside, and its content security
policy forbids the rest. All text from outside is escaped. Both files are written beside their place and then renamed, so a
reader never meets half a report. What a report says is decided elsewhere.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gonio.errors import DatasetError
from gonio.files import replace_atomically
from gonio.report import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_BYTES = 10_000_000
_MAX_DOCUMENT = 200_000  # characters of one document
_RESOLUTIONS = (style.DPI, 110, 75)  # tried in turn until the page fits

Cell = str | float | int | bool | None

_CSS = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, "Segoe UI", "Helvetica Neue", Arial, sans-serif; color: #1a1a1a; background: #fff;
  max-width: 62rem; margin: 2rem auto; padding: 0 1.2rem; overflow-wrap: break-word; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 1rem; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid #ccc; padding-bottom: .2rem; }
.warnings { border-left: 4px solid #d55e00; background: #fdf3ec; padding: .6rem 1rem; margin: 1rem 0; }
.warnings h2 { border: 0; margin: 0; } .warnings ul { margin: .3rem 0; padding-left: 1.2rem; }
table { border-collapse: collapse; margin: .4rem 0; font-size: .92rem; }
.wide { overflow-x: auto; margin: 1.2rem 0; }
caption { text-align: left; font-weight: 600; padding-bottom: .3rem; }
th, td { text-align: left; vertical-align: top; padding: .22rem 1rem .22rem 0; border-bottom: 1px solid #e4e4e4; }
thead th { border-bottom: 1.5px solid #555; } tbody th { font-weight: 400; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
p.note { color: #444; font-size: .9rem; margin: .2rem 0 0; max-width: 48rem; }
figure { margin: 1.6rem 0; } figure img { max-width: 100%; height: auto; display: block; }
figcaption { font-size: .92rem; color: #333; margin-top: .4rem; max-width: 48rem; }
details { margin: .4rem 0; } summary { cursor: pointer; }
pre { font-size: .8rem; background: #f6f6f6; padding: .7rem; overflow-x: auto; white-space: pre-wrap; }
@media print { body { max-width: none; margin: 0; font-size: 10pt; } figure, tr, .warnings { break-inside: avoid; }
  h2, caption { break-after: avoid; } .wide { overflow: visible; } }
"""


@dataclass(frozen=True)
class Table:
    """A table of a report.

    Attributes
    ----------
    caption : str
    header : sequence of str
    rows : sequence of sequences of str, numbers or None
        None and NaN are shown as a dash.
    note : str
        A sentence below it.
    """

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    note: str = ""


def write_report(
    path: str | Path,
    *,
    title: str,
    summary: Sequence[tuple[str, Cell]] = (),
    tables: Sequence[Table] = (),
    figures: Sequence[tuple[str, Figure]] = (),
    warnings: Sequence[str] = (),
    documents: Mapping[str, str] | None = None,
    data: Mapping[str, object] | None = None,
) -> Path:
    """Write a report as one HTML file, and what it says as JSON beside it.

    Parameters
    ----------
    path : path-like
        Of the HTML file; the twin has the same name and the ending ``.json``.
    title : str
    summary : sequence of (label, value)
    tables : sequence of Table
    figures : sequence of (caption, Figure)
    warnings : sequence of str
        Shown first.
    documents : mapping of str to str, optional
        Texts to keep with the report, such as a configuration; the page shows at most 200 000 characters of each.
    data : mapping, optional
        More for the twin, under ``"data"``; numbers that are not finite become null.

    Returns
    -------
    Path
        Of the HTML file.

    Raises
    ------
    DatasetError
        If the page would be larger than 10 MB even with coarse pictures; nothing is written then.
    """
    target = Path(path)
    texts = dict(documents or {})
    for dpi in _RESOLUTIONS:
        page = _page(title, summary, tables, figures, warnings, texts, dpi).encode("utf-8", "replace")
        if len(page) <= MAX_BYTES:
            break
    else:
        raise DatasetError(
            f"{target.name}: the report would have {len(page) / 1e6:.1f} MB, {MAX_BYTES / 1e6:g} MB are allowed; "
            "leave out figures or documents"
        )
    twin = {
        "title": title,
        "warnings": list(warnings),
        "summary": [{"label": label, "value": value} for label, value in summary],
        "tables": [
            {"caption": t.caption, "header": list(t.header), "rows": [list(row) for row in t.rows], "note": t.note}
            for t in tables
        ],
        "figures": [caption for caption, _ in figures],
        "documents": texts,
        "data": dict(data or {}),
    }
    text = json.dumps(_finite(twin), indent=1, allow_nan=False, sort_keys=False)
    write_bytes(target.with_suffix(".json"), text.encode() + b"\n")
    write_bytes(target, page)
    return target


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file whole or not at all, its folder made if needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_atomically(path, lambda temporary: temporary.write_bytes(content))


def shown(value: Cell) -> str:
    """A cell as plain text: five significant digits, a dash for what is not known."""
    if value is None or (isinstance(value, float | np.floating) and not math.isfinite(value)):
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return f"{value:.5g}"
    return str(value)


def _page(
    title: str, summary: Sequence[tuple[str, Cell]], tables: Sequence[Table], figures: Sequence[tuple[str, Figure]],
    warnings: Sequence[str], documents: Mapping[str, str], dpi: int,
) -> str:  # fmt: skip
    policy = f"default-src 'none'; img-src data:; style-src 'sha256-{_sha256(_CSS)}'; base-uri 'none'; form-action 'none'"
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en">',
        "<head>",
        '<meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{html.escape(policy)}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<meta name="referrer" content="no-referrer">',
        f"<title>{_text(title)}</title>",
        f"<style>{_CSS}</style>",
        "</head>",
        "<body>",
        f"<h1>{_text(title)}</h1>",
    ]
    if warnings:
        items = "".join(f"<li>{_text(warning)}</li>" for warning in warnings)
        parts.append(f'<section class="warnings"><h2>Warnings</h2><ul>{items}</ul></section>')
    if summary:
        rows = "".join(f'<tr><th scope="row">{_text(label)}</th><td>{_text(value)}</td></tr>' for label, value in summary)
        parts.append(f"<h2>Summary</h2><table><tbody>{rows}</tbody></table>")
    if figures:
        parts.append("<h2>Figures</h2>")
    for number, (caption, figure) in enumerate(figures, 1):
        picture = base64.b64encode(style.png(figure, dpi)).decode("ascii")
        width = round(figure.get_size_inches()[0] * 96)
        parts.append(
            f'<figure><img width="{width}" alt="{_text(caption)}" src="data:image/png;base64,{picture}">'
            f"<figcaption><b>Fig. {number}.</b> {_text(caption)}</figcaption></figure>"
        )
    if tables:
        parts.append("<h2>Tables</h2>")
        parts.extend(_table(table) for table in tables)
    if documents:
        parts.append("<h2>Documents</h2>")
    for name, text in documents.items():
        cut = text[:_MAX_DOCUMENT]
        tail = f"\n… {len(text) - len(cut)} more characters in report.json" if len(cut) < len(text) else ""
        parts.append(f"<details><summary>{_text(name)}</summary><pre>{_text(cut + tail)}</pre></details>")
    parts += ["</body>", "</html>", ""]
    return "\n".join(parts)


def _table(table: Table) -> str:
    width = len(table.header)
    numeric = [
        any(_is_number(row[k]) for row in table.rows) and all(_is_number(row[k]) or row[k] is None for row in table.rows)
        for k in range(width)
    ]
    mark = [' class="n"' if flag else "" for flag in numeric]
    head = "".join(f'<th scope="col"{mark[k]}>{_text(name)}</th>' for k, name in enumerate(table.header))
    body = "".join(
        "<tr>" + "".join(f"<td{mark[k]}>{_text(cell)}</td>" for k, cell in enumerate(row)) + "</tr>" for row in table.rows
    )
    note = f'<p class="note">{_text(table.note)}</p>' if table.note else ""
    return (
        f'<div class="wide"><table><caption>{_text(table.caption)}</caption><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table>{note}</div>"
    )


def _is_number(cell: Cell) -> bool:
    return isinstance(cell, int | float | np.number) and not isinstance(cell, bool)


def _text(value: Cell) -> str:
    clean = "".join(c if c.isprintable() or c in "\n\t" else "�" for c in shown(value))
    return html.escape(clean, quote=True)


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")


def _finite(value: object) -> object:
    """The same for JSON: NumPy types become Python's, numbers that are not finite null, keys strings."""
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _finite(value.tolist())
    if isinstance(value, np.generic):
        return _finite(value.item())
    if isinstance(value, list | tuple | set | frozenset):
        return [_finite(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str | int | bool | None):
        return value
    return str(value)
