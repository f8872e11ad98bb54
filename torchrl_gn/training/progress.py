"""Progress bars of long work: data collection and training, with checkpoints."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from torchrl_gn.data import TrajectoryDataset, create_dataset
from torchrl_gn.evaluation.errors import HORIZONS
from torchrl_gn.scenes import Scene
from torchrl_gn.training.checkpoint import Checkpoint, save_checkpoint
from torchrl_gn.training.ray_cluster import RayCluster
from torchrl_gn.training.tracking import Tracker
from torchrl_gn.training.trainer import Trainer

HORIZON = max(HORIZONS)
"""Steps of the longest rollouts that recipes measure."""


@contextmanager
def collecting(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar of data collection; yield the callback for ``create_dataset(..., progress=...)``."""
    with tqdm(desc=f"collecting {what}", unit=" trajectories", leave=False) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def dataset_with_progress(
    folder: Path, scene: Scene, data: Mapping[str, Any], *, variants: int | None = None
) -> TrajectoryDataset:
    """Create, complete or open a system's data set, with a progress bar.

    Args:
        folder: parent of the data sets ``<name>`` and, with variants, ``<name>_variants``.
        scene: the scene.
        data: numbers of ``train``, ``validation`` and ``test`` trajectories, ``length`` in control steps, ``seed``, and
            optionally ``ray``, the address of a Ray cluster to simulate on.
        variants: random variants per split. Default: the scene itself.

    Raises:
        ValueError: if trajectories are shorter than the longest rollout measured.
    """
    if data["length"] < HORIZON:
        raise ValueError(f"data.length={data['length']} is too short: errors are measured over {HORIZON} steps.")
    name = scene.name if variants is None else f"{scene.name}_variants"
    options: dict[str, Any] = {split: data[split] for split in ("train", "validation", "test")}
    options |= {"steps": data["length"], "seed": data["seed"], "variants": variants}
    address = data.get("ray")
    with collecting(f"data of {scene.name}") as show:
        if address is None:
            return create_dataset(folder / name, scene, **options, progress=show)
        with RayCluster(address) as cluster:
            # The cluster simulates one chunk per core.
            options |= {"map_chunks": cluster.imap, "num_threads": 1}
            return create_dataset(folder / name, scene, **options, progress=show)


def cut_short_note(trainer: Trainer, folder: Path) -> str | None:
    """Say how to resume a training in ``folder`` that ran out of minutes before steps; None for any other."""
    budget = trainer.budget
    if not trainer.cut_short or budget.steps is None or budget.minutes is None:
        return None
    return (
        f"Cut short by minutes={budget.minutes:g}, at {trainer.step:,} of {budget.steps:,} steps; more would lower the"
        f" errors. To resume, run the same command with run_dir={folder} minutes={2 * budget.minutes:g}"
    )


@contextmanager
def saving(save: Callable[[], None], seconds: Callable[[], float], every: float) -> Iterator[Callable[[], None]]:
    """Save on Ctrl-C; yield a function that saves if ``every`` seconds of ``seconds()`` passed since it last did."""
    last = seconds()

    def save_when_due() -> None:
        nonlocal last
        if seconds() - last > every:
            save()
            last = seconds()

    try:
        yield save_when_due
    except KeyboardInterrupt:
        save()
        raise


def train_with_progress(
    trainer: Trainer,
    path: Path,
    resumed: Checkpoint | None,
    tracker: Tracker,
    *,
    scene: Scene | Sequence[Scene],
    config: Mapping[str, Any],
    name: str = "",
) -> dict[str, list]:
    """Train with a progress bar; save regularly, on Ctrl-C and, with the best weights, at the end.

    With several processes, only rank 0 shows, logs and saves.

    Args:
        trainer: the trainer.
        path: checkpoint to write.
        resumed: checkpoint to resume from, if any.
        tracker: logs losses and validation errors.
        scene: the scene, or scenes, trained on.
        config: configuration of the run; ``checkpoint_seconds`` are the training seconds between checkpoints.
        name: prefix of logged names, if a run trains several models.

    Returns:
        ``"seconds"`` and mean ``"loss"`` of every 100 steps.
    """
    prefix = f"{name}/" if name else ""
    curves: dict[str, list] = {"seconds": [], "loss": []}
    if resumed is not None:
        trainer.load_state_dict(resumed.training)
        curves = resumed.training["curves"]
    if not trainer.workers.first:
        for _ in trainer.run():
            pass
        return curves

    def save() -> None:
        state = {**trainer.state_dict(), "curves": curves}
        save_checkpoint(path, trainer.model, scene=scene, config=config, training=state)

    losses: list[float] = []
    options: dict[str, Any] = {
        "desc": f"training {name}".strip(),
        "initial": 100 * trainer.fraction,
        # Equal shares of the budget take equal time, so an unsmoothed rate gives the remaining time.
        "smoothing": 0,
        "bar_format": "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}",
    }
    with (
        tqdm(total=100, leave=False, **options) as bar,
        saving(save, lambda: trainer.seconds, config["checkpoint_seconds"]) as save_when_due,
    ):
        for progress in trainer.run():
            losses.append(progress.loss)
            if progress.step % 100 == 0:
                mean = sum(losses) / len(losses)
                losses.clear()
                curves["seconds"].append(progress.seconds)
                curves["loss"].append(mean)
                tracker.log({f"{prefix}train/loss": mean, f"{prefix}train/seconds": progress.seconds}, progress.step)
                bar.set_postfix(step=progress.step, loss=f"{mean:.2e}", best_error=f"{trainer.best:.2e}", refresh=False)
            bar.update(100 * progress.fraction - bar.n)
            if progress.validation is not None:
                tracker.log({f"{prefix}validation/rollout_error": progress.validation}, progress.step)
            save_when_due()
    trainer.restore_best()
    save()
    return curves
