"""What a person at a terminal sees of long work, shared by the recipes."""

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
    """Progress bar of collecting data, as ``create_dataset(..., progress=...)`` wants it.

    Args:
        what: what is collected.
    """
    with tqdm(desc=f"collecting {what}", unit=" trajectories", leave=False) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def dataset_with_progress(
    folder: Path, scene: Scene, data: Mapping[str, Any], *, variants: int | None = None
) -> TrajectoryDataset:
    """Make a system's data set, finish it or open the one that is there, with a progress bar.

    Args:
        folder: holds the data sets, each in a folder of its own: ``<name>``, of variants ``<name>_variants``.
        scene: the scene.
        data: configuration of the data: trajectories to ``train``, for ``validation`` and to ``test``, their ``length``
            in control steps, and their ``seed``; if it has ``ray``, the address of a Ray cluster to simulate on.
        variants: number of random variants in each split. Default: all trajectories are of the scene itself.

    Raises:
        ValueError: if trajectories are too short for the errors that recipes measure.
    """
    if data["length"] < HORIZON:
        raise ValueError(f"data.length={data['length']} is too short: errors are measured over {HORIZON} steps.")
    name = scene.name if variants is None else f"{scene.name}_variants"
    sizes = {split: data[split] for split in ("train", "validation", "test")}
    options: dict[str, Any] = {"steps": data["length"], "seed": data["seed"], "variants": variants}
    address = data.get("ray")
    with collecting(f"data of {scene.name}") as show:
        if address is None:
            return create_dataset(folder / name, scene, **sizes, **options, progress=show)
        with RayCluster(address) as cluster:
            # Every core has a chunk of its own.
            options |= {"map_chunks": cluster.imap, "num_threads": 1}
            return create_dataset(folder / name, scene, **sizes, **options, progress=show)


def cut_short_note(trainer: Trainer, folder: Path) -> str | None:
    """Tell how to go on with a training whose minutes were over before its steps were done; None for another.

    Args:
        trainer: what has trained.
        folder: the run's folder.
    """
    budget = trainer.budget
    if not trainer.cut_short or budget.steps is None or budget.minutes is None:
        return None
    return (
        f"Cut short by minutes={budget.minutes:g}, at {trainer.step:,} of {budget.steps:,} steps: the errors are larger"
        f" than they would be. To go on: the same command with run_dir={folder} minutes={2 * budget.minutes:g}"
    )


@contextmanager
def saving(save: Callable[[], None], seconds: Callable[[], float], every: float) -> Iterator[Callable[[], None]]:
    """Save on Ctrl-C, and whenever what this yields is called and enough time has passed since the last time.

    Args:
        save: saves.
        seconds: spent on what is saved.
        every: seconds between saves.
    """
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
    begun: Checkpoint | None,
    tracker: Tracker,
    *,
    scene: Scene | Sequence[Scene],
    config: Mapping[str, Any],
    name: str = "",
) -> dict[str, list]:
    """Train to the end with a progress bar, saving now and then, on Ctrl-C and at the end, with the best weights.

    Of several workers the first shows, logs and saves, and the others train along.

    Args:
        trainer: what trains.
        path: the checkpoint to write.
        begun: the checkpoint to go on from, if the run was begun before.
        tracker: where losses and validation errors are logged.
        scene: the scene, or scenes, trained on.
        config: configuration of the run; its ``checkpoint_seconds`` are the training seconds between checkpoints.
        name: what is trained, where a run trains several: it begins the names in the log.

    Returns:
        ``"seconds"`` and mean ``"loss"`` of every 100 steps.
    """
    prefix = f"{name}/" if name else ""
    curves: dict[str, list] = {"seconds": [], "loss": []}
    if begun is not None:
        trainer.load_state_dict(begun.training)
        curves = begun.training["curves"]
    if not trainer.workers.first:
        for _ in trainer.run():
            pass
        return curves

    def save() -> None:
        state = {**trainer.state_dict(), "curves": curves}
        save_checkpoint(path, trainer.model, scene=scene, config=config, training=state)

    losses: list[float] = []
    start = 100 * trainer.fraction
    # Equal shares take equal time, so that the remaining time is what the bar says.
    style = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}"
    with (
        tqdm(
            total=100, initial=start, smoothing=0, bar_format=style, desc=f"training {name}".strip(), leave=False
        ) as bar,
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
