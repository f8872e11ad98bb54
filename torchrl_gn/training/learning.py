"""What a person at a terminal sees of a policy being learned, and what is left of it; shared by the recipes."""

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
    trainer: OffPolicyTrainer, path: Path, begun: Checkpoint | None, tracker: Tracker, *, config: Mapping[str, Any]
) -> None:
    """Learn to the end with a progress bar, saving now and then, on Ctrl-C and at the end.

    Args:
        trainer: what learns.
        path: the checkpoint to write.
        begun: the checkpoint to go on from, if the run was begun before.
        tracker: where losses and returns are logged.
        config: configuration of the run; its ``checkpoint_seconds`` are the seconds between checkpoints.
    """
    if begun is not None:
        trainer.load_state_dict(begun.training)

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
    """Write ``curve.json``, ``curve.png`` and ``metrics.json``, and print a table and the paths.

    Args:
        trainer: what has learned.
        run: where to.
        tracker: what the figure is logged with.
        label: what to call the agent.
        seed: of the run.
        more: further numbers of the metrics.
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
    tracker.finish(numbers, [*run.written, run.checkpoint], trainer.frames)
    width = max(map(len, numbers))
    for name, value in numbers.items():
        tqdm.write(f"{name:{width}}  {value:,.4g}")
    for path in [*run.written, run.checkpoint]:
        tqdm.write(str(path))
