"""Train a graph-network forward model and measure how well it predicts.

    python recipes/forward_model.py [system=swimmer6] [steps=3000] [minutes=8] [key=value ...]
    python recipes/forward_model.py system=[pendulum,cartpole,acrobot,swimmer6] zero_shot=[swimmer9]

Reproduces the paper's Figures "Evaluation rollout in a Swimmer6" and "One-step and 100-step rollout errors". Collects
random trajectories in MuJoCo, trains the forward model on them, and measures one-step and rollout errors on held-out
trajectories. Ctrl-C saves everything; the same `run_dir` resumes the run.

- Several systems get equal shares of every batch (paper: "Learning a forward model for multiple systems").
- For an MJCF file, the recipe also reports errors for calm, fast and full random controls (`data.pace`), where these
  differ, and the errors of MuJoCo itself at half its physics step, which show how predictable the robot is at all.
- `zero_shot` systems are only evaluated (paper: Figure "Zero-shot dynamics prediction").
- `parametrized=true` trains on random variants of the systems, by default one per trajectory (paper: SM "Datasets"),
  and evaluates on new variants and on the standard systems. Among several systems, those without variants keep their
  standard parameters.
- `physics=scene "physics_options={scale: {mass: 1.2, friction: 0.8}}"` trains the network to correct MuJoCo's
  prediction with wrong parameters; `physics=robot.xml` or `physics=robot.py:function` names other known physics. This
  takes one system.
- `start_from=cheetah data.extra=runs/mpc/<time>/gn.safetensors` trains a model of the package further; episodes of
  recipes/mpc.py are half of its data.

Writes config.yaml, metrics.json, the checkpoint, a figure of predicted against true states and a video to its run
folder (`run_dir=PATH`). All options: recipes/config/forward_model.yaml. Results:
docs/results/forward-predictions.md; times: docs/results/any-processor.md.
"""

from __future__ import annotations

import math
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig, ListConfig, OmegaConf
from tqdm import tqdm

from _common import (
    as_list,
    clean_exit,
    finish_run,
    keep_inputs,
    load_system,
    refuse_without_effect,
    resumed_checkpoint,
    with_help,
)
from _common.models import build_model, load_physics
from _common.progress import cut_short_note, poor_note, train_with_progress
from _common.training_data import Task, check_lengths, make_buffer, make_tasks
from torchrl_gn import load_pretrained
from torchrl_gn.data import Simulator, collect_trajectories, has_paces, trajectory_buffer
from torchrl_gn.data.collect import check_bounds
from torchrl_gn.dynamics import ForwardModel, Physics
from torchrl_gn.evaluation import (
    ErrorTable,
    baseline_errors,
    evaluate_errors,
    half_step_errors,
    plot_errors,
    plot_training_curve,
    report,
    summary,
)
from torchrl_gn.objectives import ForwardModelLoss, SeveralScenesLoss
from torchrl_gn.scenes import Scene
from torchrl_gn.training import Budget, RunFolder, Tracker, Trainer, Workers, join_workers, make_optimizer, plain_config

_SIDE_SEQUENCES = 200  # most test sequences of an extra table: of a single pace, or of MuJoCo at half its step
# Options that may change when a run resumes.
MAY_CHANGE = (
    "minutes",
    "steps",
    "clock",
    "threads",
    "device",
    "logger",
    "run_dir",
    "checkpoint_seconds",
    "patience",
    "horizons",
    "zero_shot",
    "data.ray",
)


def load_scenes(cfg: DictConfig, names: str | ListConfig) -> list[Scene]:
    """Load the scene of each name."""
    return [load_system(cfg, name) for name in as_list(names)]


def make_model(cfg: DictConfig, scenes: list[Scene], physics: Physics | None) -> ForwardModel:
    """Return a model with fresh weights, or the one of ``start_from``."""
    if cfg.start_from is not None:
        checkpoint, because = load_pretrained(cfg.start_from, physics=physics), f"start_from={cfg.start_from}"
        refuse_without_effect(cfg, Path(__file__), ("model",), because=because, trained=checkpoint.config)
        return checkpoint.model
    if cfg.model.core == "mlp" and len(scenes) > 1:
        raise ValueError("model.core=mlp is tied to one system; name one, or use a graph network.")
    return build_model(scenes, cfg.model, physics=physics)


def make_trainer(cfg: DictConfig, model: ForwardModel, tasks: list[Task], workers: Workers) -> Trainer:
    """Wire data, loss and optimiser together."""
    losses, device = [], next(model.parameters()).device
    for index, task in enumerate(tasks):
        noise = torch.Generator().manual_seed(cfg.seed + 1000 * index + 1_000_000 * workers.rank)
        loss = ForwardModelLoss(task.bind(model), noise=cfg.noise, size_floor=cfg.size_floor, generator=noise)
        losses.append(loss.to(device))
    unroll = None
    if cfg.unroll_fraction > 0:
        unroll = make_buffer(tasks, cfg.unroll_batch_size, cfg.unroll_steps, cfg.seed + 1, workers, device)

    def validate() -> float:
        """Return the geometric mean of the systems' 20-step errors, so that each counts on its own scale."""
        errors = [
            evaluate_errors(
                loss.model, task.dataset.validation, horizons=(20,), one_step=False, device=loss.noise_scale.device
            )["rollout_error_20"]
            for loss, task in zip(losses, tasks, strict=True)
        ]
        return math.exp(sum(math.log(max(error.total, 1e-300)) for error in errors) / len(errors))

    return Trainer(
        losses[0] if len(losses) == 1 else SeveralScenesLoss(losses),
        make_buffer(tasks, cfg.batch_size, 1, cfg.seed, workers, device),
        make_optimizer(model, cfg.optimizer, lr=cfg.lr),
        Budget(steps=cfg.steps, minutes=cfg.minutes, clock=cfg.clock),
        unroll=unroll,
        unroll_fraction=cfg.unroll_fraction,
        unroll_cost=cfg.unroll_batch_size * cfg.unroll_steps / cfg.batch_size,
        validate=validate,
        patience=cfg.patience,
        workers=workers,
    )


def fit_normalizers(cfg: DictConfig, trainer: Trainer, tasks: list[Task]) -> None:
    """Fit the normalizers to samples of every system; with ``start_from``, only the loss's scales."""
    buffers = [trajectory_buffer(task.train, batch_size=20_000, seed=cfg.seed) for task in tasks]
    samples = [buffer.sample().to(trainer.device) for buffer in buffers]
    fit = trainer.loss.fit_normalizers if cfg.start_from is None else trainer.loss.fit_scales
    fit(samples if isinstance(trainer.loss, SeveralScenesLoss) else samples[0])


def evaluate(
    cfg: DictConfig, model: ForwardModel, tasks: list[Task], unseen: list[Scene], folder: Path
) -> tuple[dict[str, ErrorTable], list[Path]]:
    """Return error tables by name of the system, and figures and videos of the training systems."""
    tables, files, horizons = {}, [], tuple(as_list(cfg.horizons))
    for task in tasks:
        name, test = task.scene.name, task.dataset.test
        place = folder if len(tasks) == 1 else folder / name
        scene = task.dataset.scene_of("test", 0)
        tables[name], written = report(task.bind(model), test, place, scene=scene, horizons=horizons)
        files += written
        if model.physics is not None:
            tables |= baseline_errors(task.scene, test, model.physics, horizons=horizons)
    others = {f"standard {task.scene.name}": (task.scene, cfg.data.test, {}) for task in tasks if task.parametrized}
    others |= {f"{scene.name} (zero-shot)": (scene, cfg.data.test, {}) for scene in unseen}
    few = min(cfg.data.test, _SIDE_SEQUENCES)
    for scene in [task.scene for task in tasks] if cfg.data.pace == "mixed" else []:
        for pace in ("calm", "fast", "full") if has_paces(Simulator(scene, 1)) else ():
            others[f"{scene.name} ({pace})"] = scene, few, {"pace": pace, "bounds": cfg.data.bounds}
    drawn: dict[str, list[torch.Tensor]] = {}
    for name, (scene, count, options) in tqdm(others.items(), desc="evaluating", disable=not others, leave=False):
        sequences = collect_trajectories(scene, count, cfg.data.length, cfg.data.seed, split=3, **options)
        if "pace" in options:
            if any(torch.equal(sequences["action"], each) for each in drawn.setdefault(scene.name, [])):
                continue  # two paces coincide: calm and fast for legs with motors, fast and full for quick servos
            drawn[scene.name].append(sequences["action"])
        tables[name] = evaluate_errors(model.bind(scene), sequences, horizons=horizons)
    for scene in [task.scene for task in tasks if "system" not in task.scene.origin]:
        options = {"pace": cfg.data.pace, "bounds": cfg.data.bounds, "split": 3}
        sequences = collect_trajectories(scene, few, cfg.data.length, cfg.data.seed, **options)
        tables[f"{scene.name}: MuJoCo at half its step"] = half_step_errors(scene, sequences, horizons=horizons)
    if len(tables) > 1:
        files.append(plot_errors(tables, folder / "errors.png"))
    return tables, list(dict.fromkeys(files))


def run_recipe(cfg: DictConfig, workers: Workers) -> None:
    """Collect, train and evaluate; only the first worker evaluates and writes."""
    torch.manual_seed(cfg.seed)
    if cfg.threads is not None or cfg.clock == "processor":  # the processor clock adds up all threads' time
        torch.set_num_threads(cfg.threads or 1)
    check_lengths(cfg.data, as_list(cfg.horizons))
    check_bounds(cfg.data.bounds)
    scenes, unseen = load_scenes(cfg, cfg.system), load_scenes(cfg, cfg.zero_shot)
    Budget(steps=cfg.steps, minutes=cfg.minutes, clock=cfg.clock)  # refuse a bad budget before anything is written
    if cfg.physics is not None and len(scenes) > 1:
        raise ValueError("physics= describes one system; name only one in system=.")
    physics = load_physics(cfg.physics, cfg.physics_options, scenes[0])
    run = workers.agree(lambda: RunFolder(cfg.run_dir, "forward_model"))
    resumed = resumed_checkpoint(cfg, run, MAY_CHANGE, physics=physics)
    model = (resumed.model if resumed else make_model(cfg, scenes, physics)).to(workers.device(cfg.device))
    if workers.first:
        keep_inputs(run, resumed=resumed is not None, data__extra=cfg.data.extra)
        run.write_config(OmegaConf.to_yaml(cfg))
    names = "-".join(scene.name for scene in scenes)
    logger = cfg.logger if workers.first else "none"
    tracker = Tracker(logger, run.path / "log", name=f"forward_model-{names}", config=cfg)

    with workers.first_goes_first():
        tasks = make_tasks(cfg, scenes, Path(cfg.data.folder) if cfg.data.folder else run.data)
    trainer = make_trainer(cfg, model, tasks, workers)
    if not resumed and (cfg.start_from is None or cfg.noise > 0):
        fit_normalizers(cfg, trainer, tasks)
    curves = train_with_progress(trainer, run.checkpoint, resumed, tracker, scene=scenes, config=plain_config(cfg))
    if not workers.first:
        return

    model.cpu()  # figures and videos need it on the CPU
    tables, files = evaluate(cfg, model, tasks, unseen, run.path)
    if curves["seconds"]:
        curve = {"loss": (curves["seconds"], curves["loss"])}
        files.append(plot_training_curve(curve, run.path / "training.png", ylabel="loss"))
    # Names of metrics begin with the system's name if there are several systems.
    metrics = tables[scenes[0].name].to_metrics() if len(scenes) == 1 else {}
    if len(tables) > 1:
        metrics |= {
            f"{name}/{key}": value for name, table in tables.items() for key, value in table.to_metrics().items()
        }
    metrics |= {
        "validation_error": trainer.best,
        "steps": trainer.step,
        "training_seconds": trainer.seconds,
        "outside_model_share": trainer.outside_share(),
    }
    for name, table in tables.items():
        tracker.log_table(f"errors of {name}", table.rows())
    print(tables[scenes[0].name] if len(tables) == 1 else summary(tables))
    for note in (poor_note(tables, trainer.step), cut_short_note(trainer, run.path)):
        if note:
            print(note)
    finish_run(cfg, run, tracker, metrics, files=files, checkpoints=[run.checkpoint], step=trainer.step)


@with_help
@hydra.main(version_base=None, config_path="config", config_name="forward_model")
@clean_exit
def main(cfg: DictConfig) -> None:
    with join_workers() as workers:
        run_recipe(cfg, workers)


if __name__ == "__main__":
    main()
