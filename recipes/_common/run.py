"""A recipe's run folder: open it, resume what it holds, and finish it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from torchrl_gn.dynamics import Physics
from torchrl_gn.training import Checkpoint, RunFolder, Tracker, load_pretrained
from torchrl_gn.training.run_folder import CONFIG_FILE, METRICS_FILE


def open_run(cfg: DictConfig, name: str) -> tuple[RunFolder, Tracker]:
    """Make the run folder of the recipe ``name``, write its ``config.yaml`` and open its log."""
    run = RunFolder(cfg.run_dir, name)
    return run, open_log(cfg, run)


def open_log(cfg: DictConfig, run: RunFolder, *, label: str | None = None) -> Tracker:
    """Write ``config.yaml`` and open the log that ``logger=`` names, called ``label`` (default: the recipe's name)."""
    run.write_config(OmegaConf.to_yaml(cfg, resolve=True))
    return Tracker(cfg.logger, run.path / "log", name=label or run.name, config=cfg)


def resumed_checkpoint(
    cfg: DictConfig, run: RunFolder, may_change: Collection[str], *, physics: Physics | None = None
) -> Checkpoint | None:
    """Load the checkpoint to resume from, None if the run is new; ``physics`` are those that its model corrects.

    Raises:
        ValueError: if an option outside of ``may_change`` differs from the checkpoint's.
    """
    if not run.checkpoint.exists():
        return None
    checkpoint = load_pretrained(run.checkpoint, physics=physics)
    run.refuse_changes(checkpoint.config, cfg, free=may_change)
    return checkpoint


def say_trained(run: RunFolder) -> None:
    """Print that the run folder's model is not trained again."""
    print(
        f"The model in {run.checkpoint} was trained before and is measured again; name a new run_dir to train another."
    )


def read_config(path: Path) -> DictConfig:
    """Read the ``config.yaml`` of a run; ValueError, with its path, if it is damaged."""
    try:
        config = OmegaConf.load(path)
    except (YAMLError, OmegaConfBaseException, ValueError, OSError, AssertionError) as error:
        raise ValueError(f"{path} is damaged ({' '.join(str(error).split())}); name a new run_dir.") from error
    if not isinstance(config, DictConfig):
        raise ValueError(f"{path} is damaged (it holds no options); name a new run_dir.")
    return config


def refuse_other_options(cfg: DictConfig, run: RunFolder, may_change: Collection[str]) -> None:
    """Refuse to resume a run whose ``config.yaml`` has other options.

    Raises:
        ValueError: if an option outside of ``may_change`` differs.
    """
    if (config := run.path / CONFIG_FILE).exists():
        run.refuse_changes(read_config(config), cfg, free=may_change)


def finish_run(
    cfg: DictConfig,
    run: RunFolder,
    tracker: Tracker,
    metrics: Mapping[str, Any],
    *,
    files: Sequence[Path] | None = None,
    checkpoints: Sequence[Path] = (),
    step: int = 0,
) -> None:
    """Write ``metrics.json``, log numbers and files, and print the paths.

    Args:
        cfg: the recipe's options.
        run: the run folder.
        tracker: the log, which is closed.
        metrics: flat names and plain numbers.
        files: figures and videos. Default: all existing files whose paths the run folder gave.
        checkpoints: models, printed last.
        step: step of the training, for the log.
    """
    numbers = run.write_metrics(metrics, seed=cfg.seed)
    tracker.finish(numbers, [*(run.written if files is None else files), *checkpoints], step)
    paths = run.written if files is None else [*files, run.path / METRICS_FILE]
    for path in [*paths, *checkpoints]:
        print(path)
