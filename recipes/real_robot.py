"""Train forward models on the logs of a robot's joints: feed-forward, recurrent, and on top of known physics.

    python recipes/real_robot.py [log=arm.npz] [timestep=0.01] ["names={angle: q, velocity: dq, command: u}"]

Follows the paper's "Real robot data" and SM "Recurrent one-step predictions". Reads a log (docs/data.md), measures its
rate, delays and noise, cuts it at gaps and jumps, and trains a feed-forward and a recurrent graph network for equal
time. Compares both with baselines on held-out episodes, or on the last part of a log of few episodes, after `burn_in`
true steps. `physics=robot.xml`, or `physics=robot.py:function` of state and action, adds this known physics and a
residual model that corrects it; parameters of the function that require gradients are first fitted to the log.
`members=5` makes an ensemble of feed-forward models, calibrates it on the validation part, and counts how many errors
lie within its standard deviations. Without a log, the recipe simulates one: the JACO arm with lagging motors, play
(hysteresis), and noisy, coarse encoders. Ctrl-C saves everything; the same `run_dir` resumes the run.

Writes config.yaml, metrics.json, a checkpoint of each model, and figures of joint angles (joints.png) and errors
(errors.png) to its run folder. All options: recipes/config/real_robot.yaml. Results: docs/results/real-arm.md.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from _common import as_list, clean_exit, finish_run, keep_inputs, open_log, with_help
from _common.models import build_model, load_physics
from _common.progress import train_with_progress
from torchrl_gn.checks import check_count
from torchrl_gn.data import (
    RobotLog,
    inspect_log,
    load_robot_log,
    log_trajectories,
    log_tree,
    simulate_log,
    trajectory_buffer,
)
from torchrl_gn.dynamics import Ensemble, ForwardModel, Physics, specialize
from torchrl_gn.evaluation import baseline_errors, calibrate, evaluate_errors, plot_errors, plot_joints, summary
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import KinematicTree, load_scene
from torchrl_gn.training import (
    Budget,
    Checkpoint,
    RunFolder,
    Tracker,
    Trainer,
    fit_physics,
    load_pretrained,
    make_optimizer,
    plain_config,
    save_checkpoint,
)
from torchrl_gn.training.checkpoint import CHECKPOINT_FILE

ENSEMBLE = "feed-forward"  # kind of the ensemble's members

# Options that may change when a run resumes.
MAY_CHANGE = ("members", "minutes", "steps", "clock", "threads", "logger", "run_dir", "checkpoint_seconds")


def read(cfg: DictConfig) -> tuple[RobotLog, KinematicTree]:
    """Read or simulate the log; return it and the robot as a kinematic tree."""
    options = plain_config(cfg)
    if cfg.log is not None:
        log = load_robot_log(cfg.log, **{key: options[key] for key in ("timestep", "names", "degrees")})
        name, joint_parents = Path(cfg.log).stem, cfg.joint_parents or ()
    else:
        own = cfg.simulated
        scene = load_scene("jaco", timestep=own.timestep)
        log = simulate_log(scene, own.episodes, own.steps, cfg.seed, **plain_config(own.faults))
        name, joint_parents = "simulated jaco", [-1, 0, 1, 2, 3, 4, 5, 5, 5]
    options = {key: options[key] for key in ("resample", "commands", "history")}
    return log, log_tree(log, name, joint_parents=joint_parents, **options)


def split(cfg: DictConfig, log: RobotLog) -> dict[str, TensorDictBase]:
    """Split the log's trajectories to train, validate and test: by episode, or by time if there are few episodes."""
    measured = inspect_log(log, jump=cfg.jump)
    lag = measured.lag if cfg.lag == "auto" else cfg.lag
    smooth = measured.half_widths if cfg.filter == "auto" else cfg.filter
    options = {"resample": cfg.resample, "lag": lag, "jump": cfg.jump, "history": cfg.history, "smooth": smooth}
    data, report = log_trajectories(log, cfg.length, **options)
    print(measured, report, sep="\n")
    shares, which = (cfg.share.validation, cfg.share.test), data["episode"]
    order = torch.from_numpy(np.random.default_rng(cfg.data_seed).permutation(len(log.length)))
    counts = [int(share * len(order)) for share in shares]
    if min(counts) < 1:
        print(
            f"{len(order)} episodes are too few to split by episode. They are split by time; the last part is the test"
            " set."
        )
        which = torch.arange(len(data))
        counts = [max(1, int(share * len(data))) for share in shares]
        order = which.roll(sum(counts))  # the last trajectories, for validation and test, come first
    parts = dict(zip(("validation", "test", "train"), order.tensor_split(np.cumsum(counts).tolist()), strict=True))
    found = {part: data[torch.isin(which, members)] for part, members in parts.items()}
    print(", ".join(f"{part}: {len(trajectories):,} trajectories" for part, trajectories in found.items()))
    if min(shares) <= 0 or not all(map(len, found.values())):
        raise ValueError(
            f"{len(log.length)} episodes cannot be split by share={plain_config(cfg.share)}, data_seed={cfg.data_seed};"
            f" give more, other shares, or a smaller length than {cfg.length}."
        )
    return found


def mirrored(tree: KinematicTree, data: TensorDictBase) -> tuple[KinematicTree, TensorDictBase]:
    """Return the robot with symmetric command bounds, and the trajectories followed by their mirror images.

    Mirror images have negated angles, velocities and commands.

    Raises:
        ValueError: if the robot has further channels, whose mirror images are unknown.
    """
    if tree.extras:
        raise ValueError(f"mirror=true knows angles, velocities and commands, not the channels {list(tree.extras)}.")
    most = np.maximum(np.abs(tree.action_low), np.abs(tree.action_high))
    image = data.clone()
    for name in {"state", "smoothed"} & set(image.keys()):
        image[name][..., 1:, 1:] *= -1  # sine and velocity
    image["action"] *= -1
    return replace(tree, action_low=-most, action_high=most), cast(TensorDictBase, torch.cat([data, image]))


def rollout_horizons(cfg: DictConfig) -> set[int]:
    """Return the horizons of the compared rollouts; ValueError if trajectories end within the burn-in."""
    longest = cfg.length - cfg.burn_in
    if longest < 1:
        raise ValueError(f"length={cfg.length} leaves no step to predict after burn_in={cfg.burn_in}.")
    return {steps for steps in as_list(cfg.horizons) if steps <= longest} | {longest}


def make_trainer(cfg: DictConfig, model: ForwardModel, tree: KinematicTree, data: dict[str, TensorDictBase]) -> Trainer:
    """Wire data, loss and optimiser together."""
    bound, recurrent = model.bind(cast(Any, tree)), model.core.recurrent
    loss = ForwardModelLoss(
        bound,
        noise=cfg.noise,
        teacher_forced_steps=cfg.burn_in if recurrent else 1,
        bptt_steps=cfg.bptt_steps,
        residual_weight=0.0 if model.physics is None else cfg.residual_weight,
        residual_noise=cfg.residual_noise,
        generator=torch.Generator().manual_seed(cfg.seed),
    )
    # Teacher-forced over the burn-in, then fed its own predictions.
    window = cfg.burn_in + cfg.unroll_steps if recurrent else 1
    size = cfg.sequence_batch_size if recurrent else cfg.batch_size
    unroll = None
    if not recurrent and cfg.unroll_fraction > 0:
        unroll = trajectory_buffer(
            data["train"], batch_size=cfg.sequence_batch_size, window=cfg.unroll_steps, seed=cfg.seed + 1
        )

    def validate() -> float:
        options: dict[str, Any] = {"horizons": rollout_horizons(cfg), "burn_in": cfg.burn_in}
        table = evaluate_errors(bound, data["validation"], one_step=False, **options)
        return torch.tensor([error.total for error in table.errors.values()]).log().mean().exp().item()

    return Trainer(
        loss,
        trajectory_buffer(data["train"], batch_size=size, window=window, seed=cfg.seed),
        make_optimizer(model, cfg.optimizer, lr=cfg.lr),
        Budget(steps=cfg.steps, minutes=cfg.minutes, clock=cfg.clock),
        unroll=unroll,
        unroll_fraction=cfg.unroll_fraction if unroll is not None else 0.0,
        validate=validate,
    )


def train(
    cfg: DictConfig,
    kind: str,
    path: Path,
    resumed: Checkpoint | None,
    tree: KinematicTree,
    data: dict,
    tracker: Tracker,
    physics: Physics | None,
    *,
    name: str | None = None,
):
    """Train a model of a kind, or resume its training; return the model and its trainer."""
    if resumed:
        model = resumed.model
    else:
        torch.manual_seed(cfg.seed)
        options = plain_config(cfg.models[kind])
        options["physics"] = physics if options.get("physics", False) else None
        model = build_model(tree, cfg.model, **options)
    trainer = make_trainer(cfg, model, tree, data)
    if not resumed:
        trainer.loss.fit_normalizers(trajectory_buffer(data["train"], batch_size=20_000, seed=cfg.seed).sample())
    train_with_progress(
        trainer, path, resumed, tracker, scene=cast(Any, tree), config=plain_config(cfg), name=name or kind
    )
    return model, trainer


def train_members(
    cfg: DictConfig, run: RunFolder, first: ForwardModel, tree: KinematicTree, data: dict, tracker: Tracker
) -> Ensemble:
    """Return an ensemble of the first feed-forward model and others with other seeds, trained in their own folders."""
    members = [first]
    for number in range(1, cfg.members):
        own, name = cfg.copy(), f"member-{number}"
        own.seed = cfg.seed + number
        path = run.path / name / CHECKPOINT_FILE
        resumed = load_pretrained(path) if path.exists() else None
        if resumed:
            run.refuse_changes(resumed.config, own, free=MAY_CHANGE)
        members.append(train(own, ENSEMBLE, path, resumed, tree, data, tracker, None, name=name)[0])
    return Ensemble(members)


@with_help
@hydra.main(version_base=None, config_path="config", config_name="real_robot")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    Budget(steps=cfg.steps, minutes=cfg.minutes, clock=cfg.clock)
    check_count("members", cfg.members, 1)
    horizons = rollout_horizons(cfg)
    log, tree = read(cfg)
    print(tree)
    data = split(cfg, log)
    if cfg.mirror:
        tree, data["train"] = mirrored(tree, data["train"])
    run = RunFolder(cfg.run_dir, "real_robot")
    physics = load_physics(cfg.physics, cfg.physics_options, tree)
    measured: dict[str, Any] = {"burn_in": cfg.burn_in, "horizons": horizons}
    tables = baseline_errors(tree, data["test"], physics, **measured)
    residual = {name for name, options in cfg.models.items() if options.get("physics", False)}
    names = [name for name in cfg.models if physics is not None or name not in residual]
    paths = {name: run.path / name / CHECKPOINT_FILE for name in names}
    there = {name: path for name, path in paths.items() if path.exists()}
    known = dict.fromkeys(residual, physics)
    resumed = {name: load_pretrained(path, physics=known.get(name)) for name, path in there.items()}
    for checkpoint in resumed.values():
        run.refuse_changes(checkpoint.config, cfg, free=MAY_CHANGE)
    keep_inputs(run, resumed=bool(resumed), log=cfg.log)
    tracker = open_log(cfg, run, label=f"real_robot-{tree.name}")
    if physics is not None and physics.trained and cfg.physics_fit:
        if not residual & resumed.keys():  # their checkpoint has the fitted parameters
            fit_physics(
                physics, tree, data["train"], steps=cfg.physics_fit, window=min(20, max(horizons)), seed=cfg.seed
            )
        tables["fitted physics"] = baseline_errors(tree, data["test"], physics.requires_grad_(False), **measured)[
            "physics"
        ]
    metrics, models = cast(dict[str, float], {}), {}
    for name, path in paths.items():
        model, trainer = train(cfg, name, path, resumed.get(name), tree, data, tracker, physics)
        models[name] = model.bind(cast(Any, tree))
        tables[name] = evaluate_errors(models[name], data["test"], keep=1, **measured)
        metrics |= {f"{name}/steps": trainer.step, f"{name}/training_seconds": trainer.seconds}
    stds: dict[str, Tensor] = {}  # of the ensemble
    if cfg.members > 1:
        ensemble = train_members(cfg, run, models[ENSEMBLE].model, tree, data, tracker)
        bound = specialize(ensemble.bind(cast(Any, tree)))
        calibrate(bound, data["validation"])
        tables["ensemble"] = evaluate_errors(bound, data["test"], keep=1, **measured)
        state, action = (cast(Tensor, data["test"][name])[0, cfg.burn_in :] for name in ("state", "action"))
        stds["ensemble"] = bound.predict(state[0], action[: max(horizons)]).std
        paths["ensemble"] = run.path / "ensemble" / CHECKPOINT_FILE
        save_checkpoint(paths["ensemble"], ensemble, scene=cast(Any, tree), config=plain_config(cfg))
    metrics |= {f"{name}/{key}": value for name, table in tables.items() for key, value in table.to_metrics().items()}
    predictions = {name: tables[name].rollouts[0] for name in paths}
    pictures = [
        plot_joints(cast(Any, data["test"]["state"])[0], predictions, tree, run.path / "joints.png", stds=stds),
        plot_errors(tables, run.path / "errors.png"),
    ]
    print(summary(tables))
    for name, table in tables.items():
        print(f"\n{name}\n{table}")
    finish_run(cfg, run, tracker, metrics, files=pictures, checkpoints=list(paths.values()), step=trainer.step)


if __name__ == "__main__":
    main()
