"""Train a graph-network forward model and say how well it predicts.

    python recipes/forward_model.py [system=swimmer6] [steps=3000] [minutes=8] [key=value ...]
    python recipes/forward_model.py system=[pendulum,cartpole,acrobot,swimmer6] zero_shot=[swimmer9]

Collects random trajectories of the true physics, trains the forward model on them, and
evaluates one-step and rollout errors on trajectories never trained on (paper: Figures
"Evaluation rollout in a Swimmer6" and "One-step and 100-step rollout errors"). Leaves
config.yaml, metrics.json, the checkpoint, a figure of predicted against true states and a
video in its run folder, `run_dir=PATH`. Ctrl-C saves everything; the same `run_dir` goes on.
Of several systems, each has an equal share of every batch (paper: "Learning a forward model for multiple
systems"); `zero_shot` systems are only evaluated (paper: Figure "Zero-shot dynamics prediction").
`parametrized=true` trains on random variants of the systems instead, each sequence of its own (paper: SM
"Datasets"), and evaluates on variants never trained on and on the standard systems; of several systems, those
without variants stay as they are.
`start_from=cheetah data.extra=runs/mpc/<time>/gn.safetensors` goes on from a model that comes with the package; half of
what it learns from are the episodes that recipes/mpc.py played with it.
All options with their defaults: recipes/config/forward_model.yaml. What came out, and how
long it took: docs/results.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import hydra
import torch
from omegaconf import DictConfig, ListConfig, OmegaConf
from safetensors.torch import load_file
from tensordict import TensorDict, TensorDictBase
from torchrl.data import ReplayBuffer, ReplayBufferEnsemble
from tqdm import tqdm

from torchrl_gn.data import TrajectoryDataset, collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel, Predictor
from torchrl_gn.evaluation import ErrorTable, evaluate_errors, plot_errors, plot_training_curve, report, summary
from torchrl_gn.objectives import ForwardModelLoss, SeveralScenesLoss
from torchrl_gn.pretrained import load_model
from torchrl_gn.scenes import ParameterNames, Scene, has_variants, load_scene
from torchrl_gn.training import (
    Budget,
    RunFolder,
    Tracker,
    Trainer,
    Workers,
    as_list,
    clean_exit,
    join_workers,
    load_checkpoint,
    make_optimizer,
    plain_config,
    with_help,
)
from torchrl_gn.training.progress import cut_short_note, dataset_with_progress, train_with_progress

# A run may go on with more time, another logger or other threads, and nothing else.
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
    "zero_shot",
    "data.ray",
)


@dataclass
class Task:
    """A system to train on.

    Attributes:
        scene: the system.
        dataset: its random trajectories.
        train: trajectories to train on, the data set's or a mixture with others.
    """

    scene: Scene
    dataset: TrajectoryDataset
    train: TensorDictBase

    @property
    def parametrized(self) -> bool:
        """Whether its sequences are of variants."""
        return "parameters" in self.train.keys()

    def bind(self, model: ForwardModel) -> Predictor:
        """Join the weights to the scene, or to its variants, whose numbers come with the samples."""
        if not self.parametrized:
            return model.bind(self.scene)
        return model.bind(self.scene, parameters_key="parameters", static_features=self.dataset.features)


def load_scenes(names: str | ListConfig, timestep: float | None) -> list[Scene]:
    """Scenes of one name or several."""
    return [load_scene(name, timestep=timestep) for name in as_list(names)]


def make_tasks(cfg: DictConfig, scenes: list[Scene], folder: Path) -> list[Task]:
    """Collect the data of every system, or find them there."""
    if cfg.data.extra is not None and (len(scenes) > 1 or cfg.parametrized):
        raise ValueError("data.extra holds trajectories of one system without variants; name that one.")
    tasks = []
    for scene in scenes:
        parametrized = cfg.parametrized and (len(scenes) == 1 or has_variants(scene))
        variants = (cfg.data.variants or cfg.data.train) if parametrized else None
        dataset = dataset_with_progress(folder, scene, cfg.data, variants=variants)
        tasks.append(Task(scene, dataset, mixture(cfg, dataset)))
    return tasks


def mixture(cfg: DictConfig, dataset: TrajectoryDataset) -> TensorDictBase:
    """Half of the training trajectories, and as many of `data.extra`, over and over where those are fewer."""
    if cfg.data.extra is None:
        return dataset.train
    count = (len(dataset.train) + 1) // 2
    own = cast(TensorDict, dataset.train[:count]).select("state", "action")
    each = []
    for source in as_list(cfg.data.extra):
        each.append(extra_trajectories(source, cfg.data.length))
        shapes, wanted = ([list(of.get(key).shape[1:]) for key in ("state", "action")] for of in (each[-1], own))
        if shapes != wanted:
            raise ValueError(
                f"data.extra={source} has states and actions [M, *] of shapes {shapes}; {cfg.system} with"
                f" data.length={cfg.data.length} has {wanted}."
            )
    more = each[0] if len(each) == 1 else cast(TensorDict, torch.cat(each))  # what lies on disk stays there
    return cast(TensorDictBase, torch.cat([own, more[torch.arange(count) % len(more)].to(own["action"].dtype)]))


def extra_trajectories(source: str, length: int) -> TensorDict:
    """Trajectories ``[M]`` of a folder, or of a file of recipes/mpc.py's episodes, in pieces of `length` steps."""
    if not source.endswith(".safetensors"):
        return cast(TensorDict, TensorDict.load_memmap(source)).select("state", "action")
    kept = load_file(source)
    episodes, steps = kept["action"].shape[:2]
    if steps < length:
        raise ValueError(f"data.extra={source} has episodes of {steps} steps, fewer than data.length={length}.")
    states, actions = (kept[name].unfold(1, length + more, length) for name, more in (("state", 1), ("action", 0)))
    pieces = {"state": states.movedim(-1, 2).flatten(0, 1), "action": actions.movedim(-1, 2).flatten(0, 1)}
    # An episode whose simulation became unstable is NaN from there on.
    whole = pieces["state"].isfinite().flatten(1).all(1)
    if not bool(whole.any()):
        raise ValueError(f"data.extra={source} has no {length} steps of an episode that stayed stable.")
    return TensorDict({name: piece[whole] for name, piece in pieces.items()}, [int(whole.sum())])


def make_model(cfg: DictConfig, scenes: list[Scene]) -> ForwardModel:
    """A model with fresh weights, or the one to start from."""
    if cfg.start_from is not None:
        return load_model(cfg.start_from).model
    if cfg.model.core == "mlp" and len(scenes) > 1:
        raise ValueError("model.core=mlp is tied to one system; name one, or use a graph network.")
    items = (scenes[0].num_nodes, scenes[0].num_edges) if cfg.model.core == "mlp" else None
    return ForwardModel(ParameterNames.of(scenes[0]), items=items, **plain_config(cfg.model))


def make_buffer(tasks: list[Task], batch_size: int, window: int, seed: int, workers: Workers) -> ReplayBuffer:
    """Transitions of one system, or equal shares of several."""
    share = max(1, batch_size // len(tasks))
    buffers = [
        trajectory_buffer(task.train, batch_size=share, window=window, seed=seed + 1000 * index, shard=workers.shard)
        for index, task in enumerate(tasks)
    ]
    if len(buffers) == 1:
        return buffers[0]
    return ReplayBufferEnsemble(*buffers, batch_size=share * len(tasks), sample_from_all=True)


def make_trainer(cfg: DictConfig, model: ForwardModel, tasks: list[Task], workers: Workers) -> Trainer:
    """Wire data, loss and optimiser together."""
    losses = []
    for index, task in enumerate(tasks):
        noise = torch.Generator().manual_seed(cfg.seed + 1000 * index + 1_000_000 * workers.rank)
        loss = ForwardModelLoss(task.bind(model), noise=cfg.noise, generator=noise)
        losses.append(loss.to(next(model.parameters()).device))
    unroll = None
    if cfg.unroll_fraction > 0:
        unroll = make_buffer(tasks, cfg.unroll_batch_size, cfg.unroll_steps, cfg.seed + 1, workers)

    def validate() -> float:
        """Geometric mean over the systems, so that each counts by its own scale."""
        errors = [
            evaluate_errors(
                loss.model, task.dataset.validation, horizons=(20,), one_step=False, device=loss.noise_scale.device
            )["rollout_error_20"]
            for loss, task in zip(losses, tasks, strict=True)
        ]
        return math.exp(sum(math.log(max(error.total, 1e-300)) for error in errors) / len(errors))

    return Trainer(
        losses[0] if len(losses) == 1 else SeveralScenesLoss(losses),
        make_buffer(tasks, cfg.batch_size, 1, cfg.seed, workers),
        make_optimizer(model.core, cfg.optimizer, lr=cfg.lr),
        Budget(steps=cfg.steps, minutes=cfg.minutes, clock=cfg.clock),
        unroll=unroll,
        unroll_fraction=cfg.unroll_fraction,
        unroll_cost=cfg.unroll_batch_size * cfg.unroll_steps / cfg.batch_size,
        validate=validate,
        patience=cfg.patience,
        workers=workers,
    )


def fit_normalizers(cfg: DictConfig, trainer: Trainer, tasks: list[Task]) -> None:
    """Take samples of every system into the statistics; of a model to start from, into the scale of the noise."""
    buffers = [trajectory_buffer(task.train, batch_size=20_000, seed=cfg.seed) for task in tasks]
    samples = [buffer.sample().to(trainer.device) for buffer in buffers]
    fit = trainer.loss.fit_normalizers if cfg.start_from is None else trainer.loss.fit_scales
    fit(samples if isinstance(trainer.loss, SeveralScenesLoss) else samples[0])


def evaluate(
    cfg: DictConfig, model: ForwardModel, tasks: list[Task], unseen: list[Scene], folder: Path
) -> tuple[dict[str, ErrorTable], list[Path]]:
    """Error tables of every system by name, and figures and videos of those trained on."""
    tables, files = {}, []
    for task in tasks:
        name, test = task.scene.name, task.dataset.test
        place = folder if len(tasks) == 1 else folder / name
        scene = task.dataset.scene_of("test", 0)
        tables[name], written = report(task.bind(model), test, place, scene=scene)
        files += written
    others = {f"standard {task.scene.name}": task.scene for task in tasks if task.parametrized}
    others |= {f"{scene.name} (zero-shot)": scene for scene in unseen}
    for name, scene in tqdm(others.items(), desc="evaluating", disable=not others, leave=False):
        sequences = collect_trajectories(scene, cfg.data.test, cfg.data.length, cfg.data.seed, split=3)
        tables[name] = evaluate_errors(model.bind(scene), sequences)
    if len(tables) > 1:
        files.append(plot_errors(tables, folder / "errors.png"))
    return tables, list(dict.fromkeys(files))


def run_recipe(cfg: DictConfig, workers: Workers) -> None:
    """Collect, train, evaluate; the first of the workers alone evaluates and writes."""
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)
    scenes, unseen = load_scenes(cfg.system, cfg.timestep), load_scenes(cfg.zero_shot, cfg.timestep)
    Budget(steps=cfg.steps, minutes=cfg.minutes, clock=cfg.clock)  # refuse a bad budget before anything is written
    run = workers.agree(lambda: RunFolder(cfg.run_dir, "forward_model"))
    begun = load_checkpoint(run.checkpoint) if run.checkpoint.exists() else None
    if begun:
        run.refuse_changes(begun.config, cfg, free=MAY_CHANGE)
    model = (begun.model if begun else make_model(cfg, scenes)).to(workers.device(cfg.device))
    if workers.first:
        run.write_config(OmegaConf.to_yaml(cfg))
    names = "-".join(scene.name for scene in scenes)
    logger = cfg.logger if workers.first else "none"
    tracker = Tracker(logger, run.path / "log", name=f"forward_model-{names}", config=cfg)

    with workers.first_goes_first():
        tasks = make_tasks(cfg, scenes, Path(cfg.data.folder) if cfg.data.folder else run.data)
    trainer = make_trainer(cfg, model, tasks, workers)
    if not begun and (cfg.start_from is None or cfg.noise > 0):
        fit_normalizers(cfg, trainer, tasks)
    curves = train_with_progress(trainer, run.checkpoint, begun, tracker, scene=scenes, config=plain_config(cfg))
    if not workers.first:
        return

    model.cpu()  # figures and videos are drawn there
    tables, files = evaluate(cfg, model, tasks, unseen, run.path)
    if curves["seconds"]:
        curve = {"loss": (curves["seconds"], curves["loss"])}
        files.append(plot_training_curve(curve, run.path / "training.png", ylabel="loss"))
    # One system's errors have plain names, those of several begin with the system's.
    metrics = tables[scenes[0].name].to_metrics() if len(scenes) == 1 else {}
    if len(tables) > 1:
        metrics |= {f"{name}/{key}": value for name, of in tables.items() for key, value in of.to_metrics().items()}
    metrics |= {
        "validation_error": trainer.best,
        "steps": trainer.step,
        "training_seconds": trainer.seconds,
        "outside_model_share": trainer.outside_share(),
    }
    metrics = run.write_metrics(metrics, seed=cfg.seed)
    for name, table in tables.items():
        tracker.log_table(f"errors of {name}", table.rows())
    tracker.finish(metrics, [*files, run.checkpoint], trainer.step)
    print(tables[scenes[0].name] if len(tables) == 1 else summary(tables))
    if note := cut_short_note(trainer, run.path):
        print(note)
    for path in [*files, run.path / "metrics.json", run.checkpoint]:
        print(path)


@with_help
@hydra.main(version_base=None, config_path="config", config_name="forward_model")
@clean_exit
def main(cfg: DictConfig) -> None:
    with join_workers() as workers:
        run_recipe(cfg, workers)


if __name__ == "__main__":
    main()
