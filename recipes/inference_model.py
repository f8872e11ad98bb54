"""Train an inference model, which identifies a system from how it moves, and the forward model that uses it.

    python recipes/inference_model.py [system=pendulum] [minutes=4] [baselines=true] [run_dir=PATH]

Reproduces the paper's Figures "System identification performance" and "System identification analysis in Pendulum".
Trains both models on random variants of the system, whose parameters they never see (paper, "Inference models"; SM
"End-to-end training algorithm for System ID"). Then identifies each of several new variants from `context_length` steps
of one trajectory, and predicts another trajectory of the variant. Compares three estimates: the variant's own, another
variant's, and one from steps without control. `baselines=true` also trains a model without identification and one with
the true parameters, for the same time. Ctrl-C saves everything; the same `run_dir` resumes the run.

Writes config.yaml, metrics.json, the checkpoint, and figures to its run folder: errors as bars (errors.png), error
against the number of observed steps (steps.png), and predictions of three systems identified with and without control
(control.png). metrics.json also holds the share of each parameter's variance that a linear map reads from the inferred
graph. All options: recipes/config/inference_model.yaml. Results: docs/results/identification.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import cast

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from tqdm import tqdm

from _common import clean_exit, finish_run, open_log, resumed_checkpoint, with_help
from _common.models import build_model, model_overrides
from _common.progress import train_with_progress
from _common.sweeps import FORWARD_MODEL, Run, refuse_failures, run_all
from _common.training_data import check_lengths, dataset_with_progress
from torchrl_gn.data import Simulator, TrajectoryDataset, collect_trajectories, spline_controls, trajectory_buffer
from torchrl_gn.data.start_states import draw_start_states
from torchrl_gn.evaluation import (
    ErrorTable,
    evaluate_errors,
    identification_errors,
    linear_probe,
    plot_bars,
    plot_loglog,
    plot_motions,
    plot_training_curve,
    summary,
)
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.objectives import IdentificationLoss
from torchrl_gn.scenes import Scene, load_scene, make_variants, parameter_ranges, sample_parameters
from torchrl_gn.training import Budget, RunFolder, Trainer, load_pretrained, make_optimizer, plain_config

# Options that may change when a run resumes.
MAY_CHANGE = (
    "minutes",
    "steps",
    "clock",
    "threads",
    "logger",
    "run_dir",
    "checkpoint_seconds",
    "baselines",
    "jobs",
    "test",
    "data.ray",
)


class TestSystems:
    """New variants with three trajectories each: one with and one without control to identify from, one to predict."""

    def __init__(self, cfg: DictConfig, scene: Scene) -> None:
        system = scene.origin["system"]
        rng = np.random.default_rng(np.random.SeedSequence(cfg.data.seed, spawn_key=(5,)))
        self.parameters = sample_parameters(system, cfg.test.systems, rng)
        self.names = list(parameter_ranges(system))
        self.scenes = make_variants(system, self.parameters, timestep=scene.timestep)
        count = cfg.test.systems
        both = collect_trajectories(self.scenes, 2 * count, cfg.data.length, cfg.data.seed, split=4)
        self.observed, self.predicted = (cast(TensorDictBase, half) for half in (both[:count], both[count:]))
        none = torch.zeros_like(cast(Tensor, self.observed.get("action"))[:, : cfg.context_length])
        start = cast(Tensor, self.observed.get("physics"))[:, 0]
        self.uncontrolled = Simulator(self.scenes).rollout(start, none).set("action", none)


def make_trainer(cfg: DictConfig, model: IdentifyingModel, scene: Scene, dataset: TrajectoryDataset) -> Trainer:
    """Wire data, loss and optimiser together."""
    noise = torch.Generator().manual_seed(cfg.seed)
    loss = IdentificationLoss(
        model,
        scene,
        context_length=cfg.context_length,
        shortest=cfg.shortest,
        num_queries=cfg.num_queries,
        noise=cfg.noise,
        generator=noise,
    )

    def buffer(batch_size: int, length: int, seed: int):
        context, queries = cfg.context_length, (cfg.num_queries, length)
        return trajectory_buffer(dataset.train, batch_size=batch_size, window=context, query_windows=queries, seed=seed)

    def validate() -> float:
        """Return the 20-step error after identification from the first ``context_length`` steps."""
        held, steps = dataset.validation, cfg.context_length
        later = TensorDict({key: held[key][:, steps:] for key in ("state", "action")}, [len(held)])
        bound, inference = loss.bound, loss.inference
        errors = identification_errors(bound, inference, held, later, steps=steps, horizons=(20,), one_step=False)
        return errors["rollout_error_20"].total

    return Trainer(
        loss,
        buffer(cfg.batch_size, 1, cfg.seed),
        make_optimizer(nn.ModuleList([model.forward_model.core, model.inference]), cfg.optimizer, lr=cfg.lr),
        Budget(steps=cfg.steps, minutes=cfg.minutes, clock=cfg.clock),
        unroll=buffer(cfg.unroll_batch_size, cfg.unroll_steps, cfg.seed + 1) if cfg.unroll_fraction > 0 else None,
        unroll_fraction=cfg.unroll_fraction,
        validate=validate,
    )


def refuse_sizes(cfg: DictConfig) -> None:
    """Raise ValueError for sizes that would fail only after the training."""
    check_lengths(cfg.data)
    if cfg.context_length + 20 > cfg.data.length:
        raise ValueError(
            f"context_length={cfg.context_length} leaves fewer than 20 of data.length={cfg.data.length} steps to"
            " predict in validation."
        )
    if cfg.test.systems < 4:
        raise ValueError(f"test.systems={cfg.test.systems} must be 4 or more: three quarters train a linear probe.")


def baselines(cfg: DictConfig, folder: Path, data: Path, systems: TestSystems, scene: Scene) -> dict[str, ErrorTable]:
    """Train models without identification and with the true parameters for the same time; return their errors."""
    runs = {}
    for name, parameters in (("no identification", "none"), ("true parameters", "scene")):
        block = {key: value for key, value in plain_config(cfg.model).items() if key != "inferred"}
        model = model_overrides(block | {"parameters": parameters})
        shared = [f"system={cfg.system}", "parametrized=true", f"data.folder={data}", f"seed={cfg.seed}"]
        budget = {key: "null" if cfg[key] is None else cfg[key] for key in ("minutes", "steps", "clock", "threads")}
        shared += [f"{key}={value}" for key, value in budget.items()]
        shared += [f"data.{key}={cfg.data[key]}" for key in ("train", "validation", "test", "length", "seed")]
        shared += [f"noise={cfg.noise}", *model]
        place = folder / name.replace(" ", "_")
        runs[name] = Run(FORWARD_MODEL, place, tuple(shared), name, goes_on=("minutes", "steps", "clock"))
    refuse_failures(run_all(runs.values(), cfg.jobs, desc="training baselines"))
    models = {
        name: load_pretrained(run.folder).model.bind(scene, parameters_key="parameters") for name, run in runs.items()
    }
    return {name: evaluate_errors(bound, systems.predicted) for name, bound in models.items()}


def identified_errors(cfg: DictConfig, model: IdentifyingModel, scene: Scene, systems: TestSystems):
    """Return error tables by kind of estimate, and the 100-step error by number of observed steps."""
    bound, inference = model.bind(scene)
    pairs = bound, inference, systems.observed, systems.predicted
    tables = {
        "identified": identification_errors(*pairs, steps=cfg.context_length),
        "identified from another system": identification_errors(*pairs, steps=cfg.context_length, wrong=True),
        "identified without control": identification_errors(bound, inference, systems.uncontrolled, systems.predicted),
    }
    curve = {}
    for steps in tqdm([steps for steps in cfg.test.steps if steps <= cfg.data.length], desc="evaluating", leave=False):
        table = identification_errors(*pairs, steps=steps, one_step=False)
        curve[steps] = table["rollout_error_100"].total
    return tables, curve


def probe(cfg: DictConfig, model: IdentifyingModel, scene: Scene, systems: TestSystems) -> dict[str, float]:
    """Return the share of each parameter's variance that a linear map reads from the inferred graph."""
    _, inference = model.bind(scene)
    state, action = (cast(Tensor, systems.observed.get(key)) for key in ("state", "action"))
    with torch.no_grad():
        parameters = inference.identify(state[:, : cfg.context_length + 1], action[:, : cfg.context_length])
    features = torch.cat([cast(Tensor, value).flatten(1) for value in parameters.values()], dim=1)
    share = linear_probe(features, torch.from_numpy(systems.parameters), train=int(0.75 * len(features)))
    return dict(zip(systems.names, share.tolist(), strict=True))


def control_figure(cfg: DictConfig, model: IdentifyingModel, scene: Scene, path: Path) -> Path:
    """Draw predictions of three systems, identified with and without control."""
    bound, inference = model.bind(scene)
    system, ranges = scene.origin["system"], parameter_ranges(scene.origin["system"])
    low, high = (np.array([getattr(one, side) for one in ranges.values()]) for side in ("low", "high"))
    scenes = make_variants(system, np.array([low, (low + high) / 2, high]), timestep=scene.timestep)
    simulator, rng, each = Simulator(scenes), np.random.default_rng(cfg.seed), np.arange(3)
    # All from one state, under one control: only the systems differ.
    start = np.repeat(draw_start_states(simulator, np.zeros(1, dtype=np.int64), rng)[0], 3, axis=0)
    controls = np.repeat(spline_controls(scene, 1, cfg.data.length, rng), 3, axis=0)
    panels = {}
    for title, factor in (("with control", 1.0), ("without control", 0.0)):
        actions = controls.copy()
        actions[:, : cfg.context_length] *= factor
        states = cast(Tensor, simulator.rollout(start, actions, each).get("state"))
        actions = torch.from_numpy(actions)
        with torch.no_grad():
            parameters = inference.identify(states[:, : cfg.context_length + 1], actions[:, : cfg.context_length])
            predicted, _ = bound.rollout(states[:, cfg.context_length], actions[:, cfg.context_length :], parameters)
        panels[f"identified {title}"] = (states, predicted)
    return plot_motions(panels, scene, path, labels=("smallest", "middle", "largest"))


@with_help
@hydra.main(version_base=None, config_path="config", config_name="inference_model")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)
    scene = load_scene(cfg.system)
    refuse_sizes(cfg)
    Budget(steps=cfg.steps, minutes=cfg.minutes, clock=cfg.clock)
    run = RunFolder(cfg.run_dir, "inference_model")
    resumed = resumed_checkpoint(cfg, run, MAY_CHANGE)
    if resumed:
        model = cast(IdentifyingModel, resumed.trained)
    else:
        model = IdentifyingModel(build_model(scene, cfg.model), **plain_config(cfg.inference))
    tracker = open_log(cfg, run, label=f"inference_model-{scene.name}")

    data = Path(cfg.data.folder) if cfg.data.folder else run.data
    dataset = dataset_with_progress(data, scene, cfg.data, variants=cfg.data.train)
    trainer = make_trainer(cfg, model, scene, dataset)
    if not resumed:
        trainer.loss.fit_normalizers(trajectory_buffer(dataset.train, batch_size=20_000, seed=cfg.seed).sample())
    curves = train_with_progress(trainer, run.checkpoint, resumed, tracker, scene=scene, config=plain_config(cfg))

    systems = TestSystems(cfg, scene)
    tables, curve = identified_errors(cfg, model, scene, systems)
    if cfg.baselines:
        tables |= baselines(cfg, run.path / "baselines", data, systems, scene)
    readable = probe(cfg, model, scene, systems)
    bars = {
        name.replace("_error", "").replace("_", " "): {
            way: {scene.name: (table[name].total, 0.0)} for way, table in tables.items()
        }
        for name in tables["identified"].errors
    }
    panel = {"observed steps": {"identified": (list(curve), list(curve.values()))}}
    files = [
        plot_bars(bars, run.path / "errors.png"),
        plot_loglog(panel, run.path / "steps.png", ylabel="100-step error"),
        control_figure(cfg, model, scene, run.path / "control.png"),
    ]
    if curves["seconds"]:
        files.append(
            plot_training_curve({"loss": (curves["seconds"], curves["loss"])}, run.path / "training.png", ylabel="loss")
        )
    metrics = {f"{way}/{key}": value for way, table in tables.items() for key, value in table.to_metrics().items()}
    metrics |= {f"observed steps/{steps}/rollout_error_100": value for steps, value in curve.items()}
    metrics |= {f"read from the inferred graph/{name}": value for name, value in readable.items()}
    metrics |= {"validation_error": trainer.best, "steps": trainer.step, "training_seconds": trainer.seconds}
    print(summary(tables))
    print("\nShare of each parameter's variance that a linear map reads from the inferred graph (1: all of it):")
    print("  ".join(f"{name} {value:.2f}" for name, value in readable.items()))
    finish_run(cfg, run, tracker, metrics, files=files, checkpoints=[run.checkpoint], step=trainer.step)


if __name__ == "__main__":
    main()
