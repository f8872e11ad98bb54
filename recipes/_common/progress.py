"""Progress bars, checkpoints and reports of trainings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from torchrl_gn.atomic import write_json
from torchrl_gn.evaluation import plot_learning_curves
from torchrl_gn.evaluation.error_table import ErrorTable
from torchrl_gn.interrupts import held
from torchrl_gn.scenes import Scene
from torchrl_gn.training.checkpoint import Checkpoint, save_checkpoint
from torchrl_gn.training.nested_state import require_like
from torchrl_gn.training.off_policy import LearningProgress, OffPolicyTrainer
from torchrl_gn.training.run_folder import RunFolder
from torchrl_gn.training.tracking import Tracker
from torchrl_gn.training.trainer import Trainer
from torchrl_gn.training.workers import Workers

_SHORT = 1000  # trainings of at most this many steps record every loss


def cut_short_note(trainer: Trainer, folder: Path) -> str | None:
    """Return a note on how to resume a training in ``folder`` that ran out of minutes before steps, else None."""
    budget = trainer.budget
    if not trainer.cut_short or budget.steps is None or budget.minutes is None:
        return None
    return (
        f"Cut short by minutes={budget.minutes:g}, at {trainer.step:,} of {budget.steps:,} steps; more would lower the"
        f" errors. To resume, run the same command with run_dir={folder} minutes={2 * budget.minutes:g}"
    )


def poor_note(tables: Mapping[str, ErrorTable], steps: int) -> str | None:
    """Return a note on errors that are no better than the persistence baseline's after ``steps`` training steps.

    Without such errors, return None.
    """
    poor = []
    for name, table in tables.items():
        bad = [error.name.replace("_", " ") for error in table.errors.values() if not error.total < 1]
        poor += [f"{name} ({', '.join(bad)})"] if bad else []
    if not poor:
        return None
    return (
        f"Errors of 1 and more are no better than predicting that nothing moves: {'; '.join(poor)}. {steps:,} steps of"
        " training or the data may be too few: raise steps=, minutes= or data.train="
    )


def say_finished(checkpoint: Path, amount: str, options: str) -> None:
    """Print that the training of a resumed run had already finished."""
    folder = checkpoint.parent.parent
    tqdm.write(f"The training in {folder} is finished ({amount}) and is evaluated again; raise {options} to go on.")


@contextmanager
def saving(
    save: Callable[[], None], seconds: Callable[[], float], every: float, *, workers: Workers | None = None
) -> Iterator[Callable[[], None]]:
    """Defer Ctrl-C until a step is complete, then save; yield the function to call after each step.

    That function raises KeyboardInterrupt if this or another one of the ``workers`` was interrupted. Otherwise it saves
    if ``every`` seconds of ``seconds()`` have passed since the last save.
    """
    last, together = seconds(), workers or Workers()
    with held() as interrupts:

        def step_is_whole() -> None:
            nonlocal last
            if together.any(interrupts.waiting):
                interrupts.let_in()
                raise KeyboardInterrupt  # another process was interrupted
            if seconds() - last > every:
                save()
                last = seconds()

        try:
            yield step_is_whole
        except KeyboardInterrupt:
            save()  # further Ctrl-C waits until it ends
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

    With several processes, only rank 0 shows progress, logs (with prefix ``name``), and saves every
    ``checkpoint_seconds`` of ``config``. Returns ``"seconds"`` and the mean ``"loss"`` of every 100 steps; for budgets
    of up to 1,000 steps, of every step.
    """
    prefix = f"{name}/" if name else ""
    curves: dict[str, list] = {"seconds": [], "loss": []}
    if resumed is not None:
        resumed.resume(trainer.load_state_dict)
        curves = resumed.resume(_curves)
        if trainer.fraction >= 1 and trainer.workers.first:
            say_finished(path, f"{trainer.step:,} steps, {trainer.seconds / 60:.3g} minutes", "steps= or minutes=")
    losses: list[float] = curves.pop("recent", [])  # since the curves' last point
    if not trainer.workers.first:
        with saving(lambda: None, lambda: 0.0, math.inf, workers=trainer.workers) as step_is_whole:
            for _ in trainer.run():
                step_is_whole()
        return curves

    def save() -> None:
        state = {**trainer.state_dict(), "curves": {**curves, "recent": losses}}
        save_checkpoint(path, trainer.model, scene=scene, config=config, training=state)

    every = 1 if (trainer.budget.steps or math.inf) <= _SHORT else 100
    options: dict[str, Any] = {
        "desc": f"training {name}".strip(),
        "initial": 100 * trainer.fraction,
        # Equal shares of the budget take equal time, so an unsmoothed rate gives the remaining time.
        "smoothing": 0,
        "bar_format": "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}",
    }
    with (
        tqdm(total=100, leave=False, **options) as bar,
        saving(save, lambda: trainer.seconds, config["checkpoint_seconds"], workers=trainer.workers) as step_is_whole,
    ):
        for progress in trainer.run():
            losses.append(progress.loss)
            if progress.step % every == 0 or progress.fraction >= 1:
                mean = sum(losses) / len(losses)
                losses.clear()
                curves["seconds"].append(progress.seconds)
                curves["loss"].append(mean)
                tracker.log({f"{prefix}train/loss": mean, f"{prefix}train/seconds": progress.seconds}, progress.step)
                bar.set_postfix(step=progress.step, loss=f"{mean:.2e}", best_error=f"{trainer.best:.2e}", refresh=False)
            bar.update(100 * progress.fraction - bar.n)
            if progress.validation is not None:
                tracker.log({f"{prefix}validation/rollout_error": progress.validation}, progress.step)
            step_is_whole()
        trainer.restore_best()
        save()
    return curves


def _curves(training: dict) -> dict[str, list]:
    curves = {"recent": [], **training["curves"]}
    require_like({"seconds": [], "loss": [], "recent": []}, curves, "training.curves")
    if len(curves["seconds"]) != len(curves["loss"]):
        raise ValueError("training.curves has lists of several lengths")
    return curves


@contextmanager
def learning(
    trainer: OffPolicyTrainer, path: Path, resumed: Checkpoint | None, tracker: Tracker, *, config: Mapping[str, Any]
) -> Iterator[Callable[[LearningProgress], None]]:
    """Resume a policy's training and show a progress bar; yield the function to call after each batch, which logs it.

    The training is saved every ``checkpoint_seconds`` of ``config``, on Ctrl-C and at the end.
    """
    if resumed is not None:
        resumed.resume(trainer.load_state_dict)
        if trainer.frames >= trainer.total:
            say_finished(path, f"{trainer.frames:,} frames", "trainer.frames=")

    def save() -> None:
        save_checkpoint(path, trainer.agent, config=config, training=trainer.state_dict())

    with (
        tqdm(total=trainer.total, initial=trainer.frames, unit=" frames", desc="learning", leave=False) as bar,
        saving(save, lambda: trainer.seconds, config["checkpoint_seconds"]) as step_is_whole,
    ):

        def log(progress: LearningProgress) -> None:
            bar.update(progress.frames - bar.n)
            tracker.log({f"train/{name}": value for name, value in progress.losses.items()}, progress.frames)
            if progress.evaluation is not None:
                bar.set_postfix({"return": f"{progress.evaluation:.4g}", "updates": progress.updates})
                numbers = {"return": progress.evaluation, "updates": progress.updates, "seconds": progress.seconds}
                tracker.log({f"evaluation/{name}": value for name, value in numbers.items()}, progress.frames)
            step_is_whole()

        yield log
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

    ``label`` names the agent in the figure; ``more`` are further metrics.
    """
    curve = trainer.curve
    write_json(run.file("curve.json"), vars(curve), checked=True)
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
