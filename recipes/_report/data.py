"""Data of the report: a JSON file for each page, with its claim, its tables, and the runs that these quote.

A page's ``runs`` are by name: a run's recipe, command, date, seed, processor, versions and ``metrics``. A run that
several pages quote is in one of them.
"""

from __future__ import annotations

import json
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import Any

from _common.options import flat
from _common.run import read_config
from torchrl_gn.atomic import read_json
from torchrl_gn.training.run_folder import CONFIG_FILE, METRICS_FILE, plain_config

INDEX, DROPPED = "index", "tried-and-dropped"
_KEPT = ("seed", "wall_clock_seconds", "processor")
_PLACES = re.compile(r"(run_dir|logger|data_dir|.*\.folder)$")  # options that do not change the results
_RECIPES = Path(__file__).parents[1]
_WIDTH = 160

Pages = Mapping[str, Mapping[str, Any]]  # the content of each page's file, by the page's name


def read_pages(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the pages by name: the claims in the order of ``index.json``, then the index and what was dropped.

    Raises:
        ValueError: if a file is damaged, or the index and the files of ``folder`` name different claims.
    """
    order = read_page(folder / f"{INDEX}.json")["order"]
    there = {file.stem for file in folder.glob("[!.]*.json")} - {INDEX, DROPPED}
    if set(order) != there or len(order) != len(set(order)):
        raise ValueError(f"{INDEX}.json and {folder} differ: {sorted(set(order) ^ there)}.")
    return {name: read_page(folder / f"{name}.json") for name in [*order, INDEX, DROPPED]}


def read_page(file: Path) -> dict[str, Any]:
    """Read a page's file; raise ValueError, naming it, if it is damaged, repeats a name or has NaN or infinity."""
    try:
        page = json.loads(file.read_text("utf-8"), object_pairs_hook=_unique)
        json.dumps(page, allow_nan=False)
        if not isinstance(page, dict):
            raise ValueError("it holds no names")
    except ValueError as error:
        raise ValueError(f"{file} is damaged ({error}); correct it, or restore it with git.") from error
    return page


def layout(page: Mapping[str, Any]) -> str:
    """Return a page as JSON, made to be read and compared line by line.

    What fits into 160 columns, or is without text, is on one line; all else has a line for each entry. Successive
    numbers share a line if their names differ only after the last slash (``round 3/frames``, ``round 3/return``).
    """
    return _laid_out(page, "") + "\n"


def run_of(name: str, page: str, pages: Pages) -> Mapping[str, Any]:
    """Return a run that ``page`` quotes: its own by ``NAME``, another page's by ``PAGE/NAME``.

    Raises:
        ValueError: if there is no such run.
    """
    other, _, run = name.rpartition("/")
    runs = pages.get(page := other or page, {}).get("runs", {})
    if run not in runs:
        raise ValueError(f"There is no run {run} in {page}.json; add it: report.py add=RUN to={page} as={run}.")
    return runs[run]


def recipe_of(run: Path) -> str:
    """Return the name of the recipe that made a run folder.

    Raises:
        ValueError: if the folder is not of a recipe, or its run has not finished.
    """
    for name in (CONFIG_FILE, METRICS_FILE):
        if not (run / name).exists():
            raise ValueError(f"add={run} has no {name}; name the folder of a finished run.")
    first = (run / CONFIG_FILE).read_text(errors="replace").partition("\n")[0]
    recipe = first.removeprefix("# A run of ")
    if recipe == first or not (_RECIPES / f"{recipe}.py").exists():
        raise ValueError(f"{run / CONFIG_FILE} begins with {first!r}, not with '# A run of' and one of our recipes.")
    return recipe


def with_run(page: Mapping[str, Any], run: Path, defaults: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return ``page`` with the metrics, command, date and versions of a run among its ``runs``, which are sorted.

    Args:
        page: a page; its run of the same name, if any, is replaced.
        run: the run folder.
        defaults: the recipe's options without a command line.
        name: name of the run within the page.

    Raises:
        ValueError: if ``run`` is not the folder of a finished run, its files are damaged, or ``name`` has a slash.
    """
    if "/" in name:
        raise ValueError(f"as={name} has a slash, which would separate a page from its run.")
    recipe, metrics = recipe_of(run), read_json(run / METRICS_FILE)
    if not isinstance(metrics, dict) or not metrics:
        raise ValueError(f"{run / METRICS_FILE} has no metrics; name the folder of a finished run.")
    options = changed_options(plain_config(read_config(run / CONFIG_FILE)), defaults)
    versions = {key.removeprefix("version/"): metrics.pop(key) for key in list(metrics) if key.startswith("version/")}
    written = datetime.fromtimestamp((run / METRICS_FILE).stat().st_mtime)
    added = {
        "recipe": recipe,
        "command": " ".join([f"python recipes/{recipe}.py", *map(shlex.quote, options)]),
        "date": f"{written:%Y-%m-%d}",
        **{key: metrics.pop(key) for key in _KEPT if key in metrics},
        "versions": versions,
        "metrics": metrics,
    }
    return {**page, "runs": dict(sorted({**page.get("runs", {}), name: added}.items()))}


def changed_options(config: Mapping[str, Any], defaults: Mapping[str, Any]) -> list[str]:
    """Return options of a run that differ from the defaults, as words of a command line, with shortened paths."""
    before, now = dict(flat(defaults)), dict(flat(config))
    changed = {key: value for key, value in now.items() if before.get(key) != value and not _PLACES.match(key)}
    return [f"{key}={_word(value)}" for key, value in changed.items()]


def _word(value: Any) -> str:
    """Write a value as Hydra reads it; an absolute path becomes ``runs/`` and its last part."""
    if isinstance(value, list):
        return f"[{','.join(map(_word, value))}]"
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{_word(each)}" for key, each in value.items()) + "}"
    if isinstance(value, str):
        if value.startswith("/"):
            return f"runs/{Path(value).name}"
        return json.dumps(value) if "=" in value else value  # quote an option of another recipe
    return json.dumps(value)


def _unique(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    if twice := [name for name, times in Counter(name for name, _ in pairs).items() if times > 1]:
        raise ValueError(f"{', '.join(twice)} is there twice")
    return dict(pairs)


def _laid_out(value: Any, indent: str) -> str:
    line = json.dumps(value, ensure_ascii=False, allow_nan=False)
    if not isinstance(value, (dict, list)) or len(indent + line) <= _WIDTH or '"' not in line:
        return line
    inner = indent + "  "
    if isinstance(value, list):
        lines = [_laid_out(each, inner) for each in value]
    else:
        entries = [(_line_of(*item), f"{json.dumps(item[0])}: {_laid_out(item[1], inner)}") for item in value.items()]
        lines = [", ".join(text for _, text in group) for _, group in groupby(entries, lambda entry: entry[0])]
    body = f",\n{inner}".join(lines)
    return f"{line[0]}\n{inner}{body}\n{indent}{line[-1]}"


def _line_of(name: str, value: Any) -> tuple[bool, str]:
    """Return what entries of a dictionary on the same line have in common."""
    number = not isinstance(value, (str, dict, list))
    return number, name.rpartition("/")[0] if number else name
