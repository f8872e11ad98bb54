"""Data of the report: one JSON file for each claim, and the runs that its tables quote."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from _common.options import flat
from torchrl_gn.atomic import read_json, write_json
from torchrl_gn.training.run_folder import CONFIG_FILE, METRICS_FILE, plain_config

INDEX, DROPPED = "index", "tried-and-dropped"
_KEPT = ("seed", "wall_clock_seconds", "processor")
_PLACES = re.compile(r"(run_dir|logger|data_dir|.*\.folder)$")  # options that do not change the results


def read_claims(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the claims by name, in the order of ``index.json``.

    Raises:
        ValueError: if the index and the files of ``folder`` name different claims.
    """
    order = read(folder, INDEX)["order"]
    there = {file.stem for file in folder.glob("*.json") if "." not in file.stem}  # others are a claim's runs and peers
    if set(order) != there - {INDEX, DROPPED} or len(order) != len(set(order)):
        raise ValueError(f"{INDEX}.json and {folder} differ: {sorted(set(order) ^ (there - {INDEX, DROPPED}))}.")
    return {name: read(folder, name) for name in order}


def read(folder: Path, name: str) -> dict[str, Any]:
    """Read ``name.json``."""
    return read_json(folder / f"{name}.json")


def read_run(folder: Path, file: str) -> dict[str, Any]:
    """Read a run that :func:`add_run` added: ``{"run": provenance, "metrics": numbers}``.

    Raises:
        ValueError: if there is no run of that name.
    """
    if not (folder / file).exists():
        raise ValueError(f"There is no {file} in {folder}; add it: report.py add=RUN_FOLDER to=CLAIM.")
    return read_json(folder / file)


def recipe_of(run: Path) -> str:
    """Return the name of the recipe that made a run folder.

    Raises:
        ValueError: if the folder has no ``config.yaml`` or no ``metrics.json``.
    """
    for name in (CONFIG_FILE, METRICS_FILE):
        if not (run / name).exists():
            raise ValueError(f"add={run} has no {name}; name the folder of a finished run.")
    return (run / CONFIG_FILE).read_text().partition("\n")[0].rpartition(" ")[2]


def add_run(folder: Path, run: Path, claim: str, defaults: Mapping[str, Any], name: str | None = None) -> Path:
    """Put a run's metrics, command, date and versions into ``folder`` and return the file.

    Args:
        folder: folder of the report's data.
        run: the run folder.
        claim: the claim whose tables quote the run.
        defaults: the recipe's options without a command line.
        name: name of the run within the claim; by default the run folder's.

    Raises:
        ValueError: if there is no such claim, or ``run`` is not the folder of a finished run.
    """
    if claim not in (claims := read_claims(folder)):
        raise ValueError(f"to={claim} is not a claim; use one of {sorted(claims)}.")
    recipe, metrics = recipe_of(run), read_json(run / METRICS_FILE)
    options = changed_options(plain_config(OmegaConf.load(run / CONFIG_FILE)), defaults)  # pyright: ignore
    versions = {key.removeprefix("version/"): metrics.pop(key) for key in list(metrics) if key.startswith("version/")}
    written = datetime.fromtimestamp((run / METRICS_FILE).stat().st_mtime)
    provenance = {
        "recipe": recipe,
        "command": " ".join([f"python recipes/{recipe}.py", *map(shlex.quote, options)]),
        "date": f"{written:%Y-%m-%d}",
        **{key: metrics.pop(key) for key in _KEPT if key in metrics},
        "versions": versions,
    }
    file = folder / f"{claim}.{name or run.name}.{METRICS_FILE}"
    write_json(file, {"run": provenance, "metrics": metrics})
    return file


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
