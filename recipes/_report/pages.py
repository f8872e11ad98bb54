"""Pages of the report, made from its data: an index, one for each claim, and one of what was tried and dropped."""

from __future__ import annotations

import json
import math
import re
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from _report.curves import ahead, curve_table, mean_return, peer_table
from _report.data import DROPPED, INDEX, Pages, run_of

VERDICTS = ("holds", "in part", "does not hold")
MOST_COLUMNS, LONGEST_CELL, MOST_SENTENCES = 8, 72, 5
_MADE = "<!-- Made by recipes/report.py from {file}; change that. -->\n"


def make_pages(data: Pages) -> dict[str, str]:
    """Return every page's text by file name.

    Raises:
        ValueError: if data break a rule of the report: an unknown verdict, a table with more than eight columns or
            rows of another length, a cell of more than 40 characters, more than five sentences, a quoted run or number
            that is missing. The message names the claim.
    """
    pages, rows = {}, []
    for name in data[INDEX]["order"]:
        try:
            pages[f"{name}.md"] = _claim_page(name, data)
            rows.append(_index_row(name, data))
        except (KeyError, ValueError) as error:
            raise ValueError(f"{name}.json: {error}") from error
    return {
        **pages,
        "README.md": _index_page(data[INDEX], rows),
        f"{DROPPED}.md": _dropped_page(data[DROPPED]),
    }


def fill_readme(text: str, data: Pages) -> str:
    """Return README's text with the table of its section "Results" made from the index's ``headlines``.

    Raises:
        ValueError: if that section does not begin with a table, or a quoted run is missing.
    """
    headlines = data[INDEX]["headlines"]
    rows = [[_filled(cell, INDEX, data) for cell in row] for row in headlines["rows"]]
    table = markdown_lines([headlines["columns"], *rows])
    filled, found = re.subn(r"(?<=\n## Results\n\n)(\|.*\n)+", lambda _: f"{table}\n", text)
    if not found:
        raise ValueError('README.md has no table at the beginning of its section "## Results".')
    return filled


def _index_page(index: Mapping[str, Any], rows: Sequence[Sequence[str]]) -> str:
    parts = [
        f"# {index['title']}",
        *index["intro"],
        f"Machine: {index['machine']} Versions: {index['versions']}",
        _table(["claim", "verdict", "headline figure", "page"], rows),
        *index["notes"],
        _MADE.format(file="data/*.json"),
    ]
    return "\n\n".join(parts)


def _index_row(name: str, data: Pages) -> list[str]:
    claim = data[name]
    short = claim["short"] if claim["of"] == "paper" else f"*{claim['short']}*"
    return [short, claim["verdict"], _filled(claim["headline"], name, data), f"[{claim['title']}]({name}.md)"]


def _claim_page(name: str, data: Pages) -> str:
    claim = data[name]
    if claim["verdict"] not in VERDICTS:
        raise ValueError(f"verdict={claim['verdict']!r} must be one of {VERDICTS}.")
    if len(claim["text"]) > MOST_SENTENCES:
        raise ValueError(f"{len(claim['text'])} sentences of text; {MOST_SENTENCES} at most.")
    qualified = f" {_filled(claim['qualified'], name, data)}." if "qualified" in claim else ""
    parts = [f"# {claim['title']}", claim["claim"], f"**Verdict: {claim['verdict']}.**{qualified}"]
    for figure in claim.get("figures", ()):
        parts.append(f"![{figure['caption']}](../images/{figure['file']})")
    if "figure" in claim:
        alt = _filled(claim["figure"]["alt"], name, data)
        parts.append(f"![{alt}](../images/results/{name}.png)")
    for table in claim["tables"]:
        table = _with_rows(table, claim)
        rows = [[shown(cell, name, data) for cell in row] for row in table["rows"]]
        parts += [_filled(table["title"], name, data), _table(table["columns"], rows)]
    if "command" in claim:
        parts.append("```sh\n" + "\n".join(claim["command"]) + "\n```")
    facts = {key: claim[key] for key in ("seeds", "time", "machine") if key in claim}
    sentences = [f"{key.capitalize()}: {value}." for key, value in facts.items()]
    other = "Versions" if "machine" in claim else "Machine and versions"
    parts.append(" ".join([*sentences, f"{other}: [index](README.md).", f"Source: {_source(name, claim)}."]))
    parts.append("\n".join(f"- {_filled(sentence, name, data)}" for sentence in claim["text"]))
    return "\n\n".join([*parts, _MADE.format(file=f"data/{name}.json")])


def _with_rows(table: Mapping[str, Any], claim: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the table, with columns and rows from the claim's learning curves or peers if it has that option."""
    if "curves" in table:
        return {**table, **curve_table(claim, table["curves"])}
    return {**table, **peer_table(claim)} if "peers" in table else table


def _dropped_page(dropped: Mapping[str, Any]) -> str:
    parts = [f"# {dropped['title']}", dropped["intro"]]
    for table in dropped["tables"]:
        parts += [f"## {table['title']}", _table(table["columns"], table["rows"])]
    return "\n\n".join([*parts, _MADE.format(file=f"data/{DROPPED}.json")])


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; raise ValueError for too many columns, a row of another length or a long cell."""
    if len(columns) > MOST_COLUMNS:
        raise ValueError(f"a table has {len(columns)} columns, {columns}; {MOST_COLUMNS} at most.")
    for row in [columns, *rows]:
        if len(row) != len(columns):
            raise ValueError(f"the row {row} has {len(row)} cells for {len(columns)} columns.")
        for cell in row:
            if len(re.sub(r"\]\([^)]*\)|[*`\[]", "", cell)) > LONGEST_CELL:
                raise ValueError(f"the cell {cell!r} has more than {LONGEST_CELL} characters.")
    return markdown_lines([columns, *rows])


def markdown_lines(rows: Sequence[Sequence[str]]) -> str:
    """Return rows as Markdown; the first row is the head."""
    lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def shown(cell: Any, name: str, data: Pages) -> str:
    """Return the text of a cell of the page ``name``.

    A string stands for itself, a list for its parts, and ``{"metric", "of", "format"}`` for a run's number, or the mean
    over a list of runs, times ``times``. With ``rms``, an error or a baseline becomes a root mean square, in metres,
    radians, ... ``{"ahead", "of"}`` stands for the number of tasks on which a claim's curves are ahead of all peers at
    ``ahead`` frames, and ``{"mean_return", "by", "of"}`` for a mean over its tasks (``curves.mean_return``).
    """
    if isinstance(cell, list):
        return " / ".join(shown(each, name, data) for each in cell)
    if isinstance(cell, Mapping) and "ahead" in cell:
        return ahead(data[cell["of"]], cell["ahead"])
    if isinstance(cell, Mapping) and "mean_return" in cell:
        return mean_return(data[cell["of"]], cell["mean_return"], cell["by"])
    return _number(cell, name, data) if isinstance(cell, Mapping) else str(cell)


def _number(cell: Mapping[str, Any], name: str, data: Pages) -> str:
    """Return a cell's number as text, the mean if ``of`` lists several runs; "diverges" if one is not finite."""
    runs = [cell["of"]] if isinstance(cell["of"], str) else cell["of"]
    values = [value for run in runs if (value := _value(cell, run, name, data)) is not None]
    if len(values) < len(runs):
        return "diverges"
    mean = statistics.fmean(values) * cell.get("times", 1)
    text = re.sub(r"e([+-])0*(\d)", lambda match: f"e{match[1].strip('+')}{match[2]}", format(mean, cell["format"]))
    return f"**{text}**" if cell.get("bold") else text


def _value(cell: Mapping[str, Any], run: str, name: str, data: Pages) -> float | None:
    """Return a run's metric, or sum of metrics, divided by ``over``; None if it is not finite.

    ``over`` is a metric of the same run, or ``{"metric", "of"}`` for one of another run.
    """
    metrics = run_of(run, name, data)["metrics"]
    names = [cell["metric"]] if isinstance(cell["metric"], str) else cell["metric"]
    if any(metrics[each] is None for each in names):
        return None
    value = sum(metrics[each] for each in names)
    if cell.get("rms"):
        horizon, *baseline, component = names[0].split("/")
        value = math.sqrt(value if baseline else value * metrics[f"{horizon}/baseline/{component}"])
    if "over" in cell:
        over = cell["over"] if isinstance(cell["over"], Mapping) else {"metric": cell["over"], "of": run}
        value /= run_of(over["of"], name, data)["metrics"][over["metric"]]
    return value


def _filled(text: str, name: str, data: Pages) -> str:
    """Return a text of the page ``name`` with the page's ``values`` in place of their ``{name}``."""
    values = data[name].get("values", {})
    return re.sub(r"\{(\w+)\}", lambda match: shown(values[match[1]], name, data), text)


def _source(name: str, claim: Mapping[str, Any]) -> str:
    """Return the sources of the numbers: files with runs that the claim quotes, and the ``source`` of its tables."""
    others = re.findall(r'"of": \[?"([^"/]+)/', json.dumps([claim["tables"], claim.get("values")]))
    files = [*([name] if "runs" in claim else []), *sorted(set(others))]
    tables = sorted({table["source"] for table in claim["tables"] if "source" in table})
    return ", ".join([*(f"[{file}.json](data/{file}.json)" for file in files), *tables])
