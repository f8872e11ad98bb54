"""Train variants of the forward model for equal time, side by side, and compare their errors.

    python recipes/compare.py [experiment=accuracy] [systems=[swimmer6,jaco]] [minutes=3] [seeds=[0]] [only=[default]]

Experiments (recipes/config/experiment):

- accuracy: effect of loss, noise, features, optimiser and sizes
- ablation: paper, SM Figure "Ablation study"
- several_systems: paper, "Learning a forward model for multiple systems"
- swimmers: paper, Figure "Zero-shot dynamics prediction"

recipes/forward_model.py trains every variant with the overrides of the experiment, on the same data: one run for each
of `systems`, or, with `train_on`, one run for all systems that it lists. The same `run_dir` keeps finished runs and
resumes interrupted ones. Runs that fail are listed, and the others continue. Tables show means over seeds and, with
several seeds, the half-range; the last column is the error relative to the first variant, as a geometric mean over
systems. Results: docs/results/README.md.

Writes config.yaml, metrics.json, the tables as table.md, bars of the errors as errors.png, and each run with its log to
its run folder.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

import hydra
from omegaconf import DictConfig

from _common import as_list, chosen_names, clean_exit, open_log, with_help
from _common.sweeps import FORWARD_MODEL, Run, folder_name, mean_and_half_range, refuse_changes, report_sweep, run_all
from torchrl_gn.training import RunFolder, plain_config

ERRORS = {"one_step_error": "one step", "rollout_error_100": "100 steps"}


@dataclass(frozen=True)
class Variant:
    """Options to compare, and with ``train_on`` the systems that one model is trained on.

    Without ``train_on``, each of the experiment's systems has its own model, or each of ``systems`` if these are given.
    """

    name: str
    overrides: tuple[str, ...] = ()
    train_on: tuple[str, ...] = ()
    systems: tuple[str, ...] | None = None

    @classmethod
    def read(cls, name: str, value: Any) -> Variant:
        """Read a variant from a list of overrides, or from a mapping of its attributes."""
        attributes = value if isinstance(value, dict) else {"overrides": value}
        return cls(name, **{key: tuple(values) for key, values in attributes.items()})

    def trainings(self, systems: Sequence[str]) -> list[tuple[str, ...]]:
        """Return the systems of each of its models, from the experiment's ``systems``."""
        if self.train_on:
            return [self.train_on]
        return [(system,) for system in systems if self.systems is None or system in self.systems]


@dataclass(frozen=True)
class Training:
    """A run, its variant, and the systems that its model is trained on."""

    run: Run
    variant: str
    systems: tuple[str, ...]

    def value(self, system: str, key: str) -> float | None:
        """Return the metric ``key`` of a system; infinite if it diverged, None if it was not measured."""
        numbers = self.run.numbers()
        names = [f"{system}/{key}", f"{system} (zero-shot)/{key}", *([key] if self.systems == (system,) else [])]
        return next((numbers[name] for name in names if name in numbers), None)


def all_trainings(cfg: DictConfig, folder: Path) -> list[Training]:
    """Return the trainings of every seed, variant and model."""
    variants = {name: Variant.read(name, value) for name, value in plain_config(cfg.variants).items()}
    chosen = chosen_names(cfg.only, variants, "Variants")
    trainings = []
    for seed, name in itertools.product(as_list(cfg.seeds), chosen):
        variant = variants[name]
        for systems in variant.trainings(as_list(cfg.systems)):
            overrides = (
                f"system=[{','.join(systems)}]" if variant.train_on else f"system={systems[0]}",
                f"zero_shot=[{','.join(as_list(cfg.zero_shot))}]",
                *(f"{option}={_plain(cfg[option])}" for option in ("minutes", "steps", "clock", "threads")),
                f"seed={seed}",
                f"data.folder={cfg.data_dir}",
                *as_list(cfg.overrides),
                *variant.overrides,
            )
            place = folder / folder_name("-".join(systems)) / folder_name(name) / f"seed{seed}"
            run = Run(FORWARD_MODEL, place, overrides, f"{', '.join(systems)}, {name}, seed {seed}")
            trainings.append(Training(run, name, systems))
    return trainings


def _plain(value: Any) -> str:
    return "null" if value is None else str(value)


def summarise(trainings: list[Training], columns: list[str]) -> tuple[list[str], dict[str, float], dict]:
    """Return tables in Markdown, metrics, and mean and half-range of every bar by error, variant and system."""
    variants = list(dict.fromkeys(training.variant for training in trainings))
    lines, metrics, bars = [], {}, {}
    for key, title in [*ERRORS.items(), ("steps", "updates")]:
        rows, first = [], {}
        for variant in variants:
            cells, logs = [], []
            for system in columns:
                own = [t for t in trainings if t.variant == variant]
                if key == "steps":
                    found = [t.run.numbers().get(key) for t in own if system in t.systems]
                else:
                    found = [t.value(system, key) for t in own]
                values = [value for value in found if value is not None]
                if not values:
                    cells.append("-")
                    continue
                center, half_range = mean_and_half_range(values)
                metrics[f"{system}/{variant}/{key}"] = center
                if key == "steps":
                    cells.append(f"{center:,.0f}")
                    continue
                cells.append(f"{center:.1e}" + (f" ± {half_range:.0e}" if len(values) > 1 else ""))
                metrics[f"{system}/{variant}/{key}/half_range"] = half_range
                bars.setdefault(title, {}).setdefault(variant, {})[system] = (center, half_range)
                if variant == variants[0]:
                    first[system] = center
                if (
                    0 < first.get(system, math.nan) < math.inf
                ):  # a first variant that diverged or has none is not a reference
                    logs.append(math.log(center / first[system]) if center > 0 else -math.inf)
            if key != "steps":
                relative = math.exp(mean(logs)) if logs else math.nan
                metrics[f"relative/{variant}/{key}"] = relative
                cells.append(f"{relative:.2f}")
            rows.append("| " + " | ".join([variant, *cells]) + " |")
        corner = title if key == "steps" else f"error, {title} (lower is better)"
        header = [corner, *columns, *(["over the first row's"] if key != "steps" else [])]
        lines += ["| " + " | ".join(header) + " |", "|---" * len(header) + "|", *rows, ""]
    return lines[:-1], metrics, bars


@with_help
@hydra.main(config_path="config", config_name="compare", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    folder = RunFolder(cfg.run_dir, "compare")
    if cfg.data_dir is None:
        cfg.data_dir = str(folder.data)
    trainings = all_trainings(cfg, folder.path)
    refuse_changes(training.run for training in trainings)
    tracker = open_log(cfg, folder)
    failed = run_all([training.run for training in trainings], cfg.jobs)
    lines, metrics, bars = summarise(trainings, [*as_list(cfg.systems), *as_list(cfg.zero_shot)])
    report_sweep(folder, lines, bars, metrics, failed, tracker, seed=as_list(cfg.seeds)[0])


if __name__ == "__main__":
    main()
