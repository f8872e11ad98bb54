"""Train a graph-network forward model of one system and say how well it predicts.

    python recipes/forward_model.py [system=swimmer6] [minutes=4] [key=value ...]

Collects random trajectories of the true physics, trains the forward model on them, and
evaluates one-step and rollout errors on trajectories never trained on (paper: Figures
"Evaluation rollout in a Swimmer6" and "One-step and 100-step rollout errors"). Leaves
config.yaml, metrics.json, the checkpoint, a figure of predicted against true states and a
video in its run folder, `run_dir=PATH`. Ctrl-C saves everything; the same `run_dir` goes on.
`parametrized=true` trains on random variants of the system instead, each sequence of its own (paper: SM
"Datasets"), and evaluates on variants never trained on and on the standard system.
All options with their defaults: recipes/config/forward_model.yaml. What came out, and how
long it took: docs/results.md.
"""

from __future__ import annotations

from typing import Any, cast

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from torchrl_gn.data import collect_trajectories, create_dataset, trajectory_buffer
from torchrl_gn.evaluation import evaluate_errors, plot_training_curve, report
from torchrl_gn.modules import BoundForwardModel, FeatureSet, ForwardModel
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.training import (
    Budget,
    RunFolder,
    Tracker,
    Trainer,
    clean_exit,
    load_checkpoint,
    make_optimizer,
    save_checkpoint,
)

# A run may go on with more time, another logger or other threads, and nothing else.
MAY_CHANGE = ("minutes", "steps", "clock", "threads", "logger", "run_dir", "checkpoint_seconds", "patience")


def options(cfg: DictConfig) -> dict[str, Any]:
    """Options as plain values."""
    return cast(dict[str, Any], OmegaConf.to_container(cfg))


def make_model(cfg: DictConfig, scene: Scene) -> ForwardModel:
    """A model with fresh weights."""
    items = (scene.num_nodes, scene.num_edges) if cfg.model.core == "mlp" else None
    return ForwardModel(FeatureSet.of(scene), items=items, **options(cfg.model))


def bind(cfg: DictConfig, model: ForwardModel, scene: Scene) -> BoundForwardModel:
    """Join the weights to the scene, or to its variants, whose numbers come with the samples."""
    return model.bind(scene, static_key="static" if cfg.parametrized else None)


def make_trainer(cfg: DictConfig, model: ForwardModel, scene, dataset) -> Trainer:
    """Wire data, loss and optimiser together."""
    bound = bind(cfg, model, scene)
    noise = torch.Generator().manual_seed(cfg.seed)
    loss = ForwardModelLoss(bound, noise=cfg.noise, generator=noise)
    train = dataset.train
    buffer = trajectory_buffer(train, batch_size=cfg.batch_size, seed=cfg.seed)
    unroll = None
    if cfg.unroll_fraction > 0:
        unroll = trajectory_buffer(train, batch_size=cfg.unroll_batch_size, window=cfg.unroll_steps, seed=cfg.seed + 1)
    validation = dataset.validation

    def validate() -> float:
        return evaluate_errors(bound, validation, horizons=(20,), one_step=False)["rollout_error_20"].total

    return Trainer(
        loss,
        buffer,
        make_optimizer(model.core, cfg.optimizer, lr=cfg.lr),
        Budget(steps=cfg.steps, minutes=cfg.minutes, clock=cfg.clock),
        unroll=unroll,
        unroll_fraction=cfg.unroll_fraction,
        validate=validate,
        patience=cfg.patience,
    )


def train(trainer: Trainer, curves: dict[str, list], run: RunFolder, tracker: Tracker, cfg: DictConfig) -> None:
    """Train with a progress bar, saving now and then and on Ctrl-C; extends the curves."""

    def save() -> None:
        state = {**trainer.state_dict(), "curves": curves}
        scene = trainer.loss.model.scene
        save_checkpoint(run.checkpoint, trainer.model, scene=scene, config=options(cfg), training=state)

    saved, losses = trainer.seconds, []
    bar = tqdm(total=100, initial=int(100 * trainer.fraction), unit="%", desc="training", leave=False)
    try:
        for progress in trainer.run():
            losses.append(progress.loss)
            if progress.step % 100 == 0:
                mean = sum(losses) / len(losses)
                losses.clear()
                curves["seconds"].append(progress.seconds)
                curves["loss"].append(mean)
                tracker.log({"train/loss": mean, "train/seconds": progress.seconds}, progress.step)
                bar.set_postfix(step=progress.step, loss=f"{mean:.2e}", best20=f"{trainer.best:.2e}")
                bar.update(int(100 * progress.fraction) - bar.n)
            if progress.validation is not None:
                tracker.log({"validation/rollout_error_20": progress.validation}, progress.step)
            if progress.seconds - saved > cfg.checkpoint_seconds:
                save()
                saved = progress.seconds
    except KeyboardInterrupt:
        save()
        raise
    finally:
        bar.close()
    trainer.restore_best()
    save()


@hydra.main(version_base=None, config_path="config", config_name="forward_model")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)
    scene = load_scene(cfg.system, timestep=cfg.timestep)
    Budget(steps=cfg.steps, minutes=cfg.minutes, clock=cfg.clock)  # refuse a bad budget before anything is written
    run = RunFolder(cfg.run_dir, "forward_model")
    begun = load_checkpoint(run.checkpoint) if run.checkpoint.exists() else None
    if begun:
        run.refuse_changes(begun.config, options(cfg), free=MAY_CHANGE)
    run.write_config(OmegaConf.to_yaml(cfg))
    tracker = Tracker(cfg.logger, run.path / "log", name=f"forward_model-{scene.name}", config=options(cfg))

    with tqdm(desc="collecting data", unit=" trajectories", leave=False) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        dataset = create_dataset(
            cfg.data.folder or run.data,
            scene,
            train=cfg.data.train,
            validation=cfg.data.validation,
            test=cfg.data.test,
            steps=cfg.data.length,
            seed=cfg.data.seed,
            variants=(cfg.data.variants or cfg.data.train) if cfg.parametrized else None,
            progress=show,
        )
    model = begun.model if begun else make_model(cfg, scene)
    trainer = make_trainer(cfg, model, scene, dataset)
    if begun:
        trainer.load_state_dict(begun.training)
    else:
        sample = trajectory_buffer(dataset.train, batch_size=20_000, seed=cfg.seed).sample()
        trainer.loss.fit_normalizers(sample)
    curves = begun.training["curves"] if begun else {"seconds": [], "loss": []}
    train(trainer, curves, run, tracker, cfg)

    table, files = report(bind(cfg, model, scene), dataset.test, run.path, scene=dataset.scene_of("test", 0))
    tables = {"": table}
    if cfg.parametrized:
        sequences = collect_trajectories(scene, cfg.data.test, cfg.data.length, cfg.data.seed, split=3)
        tables["standard/"] = evaluate_errors(model.bind(scene), sequences)
    if curves["seconds"]:
        curve = {"loss": (curves["seconds"], curves["loss"])}
        files.append(plot_training_curve(curve, run.path / "training.png", ylabel="loss"))
    metrics = run.write_metrics(
        {
            **{f"{prefix}{name}": value for prefix, of in tables.items() for name, value in of.to_metrics().items()},
            "steps": trainer.step,
            "training_seconds": trainer.seconds,
            "outside_model_share": trainer.outside_share(),
        },
        seed=cfg.seed,
    )
    tracker.log(metrics, trainer.step)
    tracker.log_table("errors", table.rows())
    tracker.log_files(files)
    tracker.close()
    print(table)
    if cfg.parametrized:
        print(f"\nThe standard {scene.name}:\n{tables['standard/']}")
    for path in [*files, run.path / "metrics.json", run.checkpoint]:
        print(path)


if __name__ == "__main__":
    main()
