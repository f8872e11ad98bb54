"""Policy training on the terminal: progress bar, checkpoints and the final report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from torchrl_gn.atomic import write_json
from torchrl_gn.evaluation import plot_learning_curves
from torchrl_gn.training.checkpoint import Checkpoint, save_checkpoint
from torchrl_gn.training.off_policy import OffPolicyTrainer
from torchrl_gn.training.progress import saving
from torchrl_gn.training.run_folder import RunFolder
from torchrl_gn.training.tracking import Tracker


def learn_with_progress(
    trainer: OffPolicyTrainer, path: Path, resumed: Checkpoint | None, tracker: Tracker, *, config: Mapping[str, Any]
) -> None:
    """Train a policy with a progress bar; save regularly, on Ctrl-C and at the end.

    Args:
        trainer: the trainer.
        path: checkpoint to write.
        resumed: checkpoint to resume from, if any.
        tracker: logs losses and returns.
        config: configuration of the run; ``checkpoint_seconds`` are the seconds between checkpoints.
    """
    if resumed is not None:
        trainer.load_state_dict(resumed.training)

    def save() -> None:
        save_checkpoint(path, trainer.agent, config=config, training=trainer.state_dict())

    with (
        tqdm(total=trainer.total, initial=trainer.frames, unit=" frames", desc="learning", leave=False) as bar,
        saving(save, lambda: trainer.seconds, config["checkpoint_seconds"]) as save_when_due,
    ):
        for progress in trainer.run():
            bar.update(progress.frames - bar.n)
            tracker.log({f"train/{name}": value for name, value in progress.losses.items()}, progress.frames)
            if progress.evaluation is not None:
                bar.set_postfix({"return": f"{progress.evaluation:.4g}", "updates": progress.updates})
                numbers = {"return": progress.evaluation, "updates": progress.updates, "seconds": progress.seconds}
                tracker.log({f"evaluation/{name}": value for name, value in numbers.items()}, progress.frames)
            save_when_due()
    save()


def report_learning(
    trainer: OffPolicyTrainer,
    run: RunFolder,
    tracker: Tracker,
    *,
    label: str,
    seed: int,
    more: Mapping[str, float] | None = None,
) -> None:
    """Write ``curve.json``, ``curve.png`` and ``metrics.json``; print a table and the paths.

    Args:
        trainer: the finished trainer.
        run: folder to write to.
        tracker: logs the metrics and files.
        label: name of the agent in the figure.
        seed: seed of the run.
        more: further metrics.
    """
    curve = trainer.curve
    write_json(run.file("curve.json"), vars(curve))
    plot_learning_curves({label: (curve.frames, [curve.returns])}, run.file("curve.png"))
    last = curve.returns[-max(1, len(curve.returns) // 10) :]
    numbers = {
        "return": curve.returns[-1],
        "best_return": max(curve.returns),
        "last_tenth_return": sum(last) / len(last),
        "frames": trainer.frames,
        "updates": trainer.updates,
        "learning_seconds": trainer.seconds,
        "updates_per_second": trainer.updates / max(trainer.seconds, 1e-9),
        "frames_per_second": trainer.frames / max(trainer.seconds, 1e-9),
        **(more or {}),
    }
    run.write_metrics(numbers, seed=seed)
    files = [*run.written, run.checkpoint]
    tracker.finish(numbers, files, trainer.frames)
    width = max(map(len, numbers))
    for line in [*(f"{name:{width}}  {value:,.4g}" for name, value in numbers.items()), *map(str, files)]:
        tqdm.write(line)
