"""Train a model of bodies that fall, bounce and slide, and measure its pose errors in metres and radians.

    python recipes/contacts.py log=cube_tosses.npz frame=body [seed=0] [key=value ...]
    python recipes/contacts.py [system=thing.xml] [timestep=0.01]

Learns from a log of body poses and an MJCF file of the bodies, by default ContactNets' cube on its table. Rolls out the
model, and MuJoCo with the MJCF's parameters, for `length` steps from the first state of each test episode, and reports
the mean distance and angle between predicted and true poses. Without a log, the recipe simulates throws and compares
with MuJoCo at half its physics step, which shows how predictable the throws are. No figure of the paper. Ctrl-C saves
everything; the same `run_dir` resumes the run.

Writes config.yaml, metrics.json and the checkpoint to its run folder. All options: recipes/config/contacts.yaml.
Results: docs/results/contacts-with-the-world.md.
"""

from __future__ import annotations

from typing import cast

import hydra
import mujoco
import numpy as np
import torch
from omegaconf import DictConfig
from scipy.spatial.transform import Rotation
from tensordict import TensorDict

from _common import clean_exit, finish_run, keep_inputs, open_log, resumed_checkpoint, with_help
from _common.models import build_model
from _common.progress import cut_short_note, train_with_progress
from torchrl_gn.data import (
    Simulator,
    UnstableSimulationError,
    load_pose_log,
    pose_trajectories,
    sample_start_states,
    trajectory_buffer,
)
from torchrl_gn.dynamics import BoundPredictor, MujocoPhysics
from torchrl_gn.evaluation import pose_errors, with_half_step
from torchrl_gn.maths import quaternion
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.training import Budget, RunFolder, Trainer, make_optimizer, plain_config

# Options that may change when a run resumes.
MAY_CHANGE = ("minutes", "steps", "clock", "threads", "logger", "run_dir", "checkpoint_seconds")
SPLITS = ("train", "validation", "test")
CUBE = """<mujoco model="cube"><option timestep="{physics_step!r}"/><worldbody>
  <geom type="plane" size="9 9 1" friction=".18"/>
  <body name="cube" pos="0 0 .0524"><freejoint/><geom type="box" size=".0524 .0524 .0524" mass=".37"/></body>
</worldbody></mujoco>"""


def make_scene(cfg: DictConfig) -> Scene:
    """Load the MJCF's scene, or the cube on a table."""
    source = cfg.system or CUBE.format(physics_step=cfg.timestep / 4)
    return load_scene(source, timestep=cfg.timestep)


def make_data(cfg: DictConfig, scene: Scene) -> dict[str, TensorDict]:
    """Return trajectories of each split: overlapping windows to train on, beginnings of episodes for the others."""
    counts = [cfg.episodes[split] for split in SPLITS]
    if min(counts) < 1:
        raise ValueError(f"Each of {SPLITS} needs episodes, got episodes={plain_config(cfg.episodes)}.")
    if cfg.log is None:
        thrown = {split: throws(cfg, scene, index, counts[index]) for index, split in enumerate(SPLITS)}
        return {**thrown, "train": _pieces(thrown["train"], cfg.window, cfg.stride)}
    log = load_pose_log(cfg.log, timestep=cfg.timestep, order=cfg.order, frame=cfg.frame)
    print(log)
    if sum(counts) > len(log.length):
        raise ValueError(f"episodes={plain_config(cfg.episodes)} are more than the log's {len(log.length)}.")
    order = np.random.default_rng(cfg.data_seed).permutation(len(log.length))
    members = dict(zip(SPLITS, np.split(order, np.cumsum(counts))[:3], strict=True))
    rest = {"steps": cfg.length, "stride": int(log.length.max())}  # only the first state of an episode is a start
    data = {split: pose_trajectories(log, scene, episodes=members[split], **rest) for split in SPLITS[1:]}
    data["train"] = pose_trajectories(log, scene, cfg.window, stride=cfg.stride, episodes=members["train"])
    return data


def throws(cfg: DictConfig, scene: Scene, split: int, count: int) -> TensorDict:
    """Simulate throws without control: free bodies from random heights and orientations, all with random velocities."""
    model, rng = scene.model, np.random.default_rng([cfg.data_seed, split])
    physics = sample_start_states(scene, count, rng)
    rates = 1 + model.nq + np.arange(model.nv)  # after time and positions
    free = model.jnt_type[model.dof_jntid] == mujoco.mjtJoint.mjJNT_FREE
    physics[:, rates[~free]] = cfg.throw.joints * rng.normal(size=(count, int((~free).sum())))
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        pose, rate = 1 + model.jnt_qposadr[joint], rates[model.jnt_dofadr[joint]]
        turn = rng.normal(size=(count, 4))
        if cfg.throw.turn is not None:  # keep the random axis, draw the angle
            half = np.deg2rad(cfg.throw.turn / 2) * rng.uniform(size=count)
            turn[:, 0] = np.linalg.norm(turn[:, 1:], axis=1) / np.tan(half)
        physics[:, pose + 2] += rng.uniform(*cfg.throw.lift, size=count)
        physics[:, pose + 3 : pose + 7] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
        physics[:, rate : rate + 3] = cfg.throw.speed * rng.normal(size=(count, 3))
        physics[:, rate + 3 : rate + 6] = cfg.throw.spin * rng.normal(size=(count, 3))
    length = cfg.length if split or cfg.train_length is None else cfg.train_length
    idle = torch.zeros(count, length, scene.num_actions, dtype=torch.float64)
    thrown = Simulator(scene).rollout(torch.from_numpy(physics), idle)
    if unstable := int((~thrown["stable"]).sum()):
        raise UnstableSimulationError(
            f"{unstable} of {count} throws became unstable; throw more slowly, or give a smaller timestep."
        )
    return TensorDict({"state": thrown["state"], "action": idle}, [count])


def _pieces(trajectories: TensorDict, window: int, stride: int) -> TensorDict:
    state, action = trajectories["state"], trajectories["action"]
    starts = range(0, action.shape[1] - window + 1, stride)
    cut = {
        "state": torch.cat([state[:, start : start + window + 1] for start in starts]),
        "action": torch.cat([action[:, start : start + window] for start in starts]),
    }
    return TensorDict(cut, [len(cut["state"])])


def alike(trajectories: TensorDict, copies: int, seed: int) -> TensorDict:
    """Return the trajectories and ``copies`` of each, whose body frame is rotated by random symmetries of the cube.

    A cube moves the same whichever face it lands on: only the names of its faces change. Velocities are in the world
    frame and stay the same.
    """
    group = torch.from_numpy(Rotation.create_group("O").as_quat()).roll(1, dims=-1)  # 24 rotations, w first
    generator, state = torch.Generator().manual_seed(seed), trajectories["state"]
    found = [state]
    for _ in range(copies):
        turn = group[torch.randint(len(group), (len(state),), generator=generator)][:, None, None]
        turned = state.clone()
        turned[:, :, 1:, 3:7] = quaternion.product(state[:, :, 1:, 3:7], turn)
        found.append(turned)
    action = torch.cat([cast(torch.Tensor, trajectories["action"])] * (1 + copies))
    return TensorDict({"state": torch.cat(found), "action": action}, [len(action)])


def make_trainer(cfg: DictConfig, bound: BoundPredictor, data: dict[str, TensorDict]) -> Trainer:
    """Wire data, loss and optimiser together; the weights with the best poses in validation are kept."""
    loss = ForwardModelLoss(
        bound, noise=cfg.noise, size_floor=cfg.size_floor, generator=torch.Generator().manual_seed(cfg.seed)
    )
    unroll = None
    if cfg.unroll_fraction > 0:
        windows = {"batch_size": cfg.unroll_batch_size, "window": cfg.unroll_steps}
        unroll = trajectory_buffer(data["train"], **windows, seed=cfg.seed + 1)

    def validate() -> float:
        errors = pose_errors(bound, data["validation"])
        return (errors.position.mean() * errors.rotation.mean()).sqrt().item()

    return Trainer(
        loss,
        trajectory_buffer(data["train"], batch_size=cfg.batch_size, seed=cfg.seed),
        make_optimizer(bound.model, cfg.optimizer, lr=cfg.lr),
        Budget(steps=cfg.steps, minutes=cfg.minutes, clock=cfg.clock),
        unroll=unroll,
        unroll_fraction=cfg.unroll_fraction,
        unroll_cost=cfg.unroll_batch_size * cfg.unroll_steps / cfg.batch_size,
        validate=validate,
    )


@with_help
@hydra.main(version_base=None, config_path="config", config_name="contacts")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    Budget(steps=cfg.steps, minutes=cfg.minutes, clock=cfg.clock)  # refuse a bad budget before anything is written
    scene = make_scene(cfg)
    data = make_data(cfg, scene)
    if cfg.cube_copies:
        if scene.num_nodes != 2:
            raise ValueError(
                f"cube_copies={cfg.cube_copies} is for one cube; scene {scene.name!r} has other bodies, too."
            )
        data["train"] = alike(data["train"], cfg.cube_copies, cfg.data_seed)
    print(", ".join(f"{split}: {len(data[split]):,} trajectories" for split in SPLITS))
    run = RunFolder(cfg.run_dir, "contacts")
    resumed = resumed_checkpoint(cfg, run, MAY_CHANGE)
    keep_inputs(run, resumed=resumed is not None, log=cfg.log)
    tracker = open_log(cfg, run, label=f"contacts-{scene.name}")
    model = resumed.model if resumed else build_model(scene, cfg.model)
    bound = model.bind(scene)
    trainer = make_trainer(cfg, bound, data)
    if not resumed:
        trainer.loss.fit_normalizers(trajectory_buffer(data["train"], batch_size=20_000, seed=cfg.seed).sample())
    train_with_progress(trainer, run.checkpoint, resumed, tracker, scene=scene, config=plain_config(cfg))
    base = int(np.flatnonzero(scene.predicted)[0])
    errors = {"model": pose_errors(bound, data["test"])}
    if scene.physics_size == 1 + scene.model.nq + scene.model.nv:
        name, truth = ("MuJoCo", scene) if cfg.log else ("MuJoCo at half its step", with_half_step(scene))
        errors[name] = pose_errors(MujocoPhysics(truth), data["test"], node=base)
    steps = cast(torch.Tensor, data["test"]["action"]).shape[1]
    print(
        f"Errors of {scene.node_names[base]!r}, means over {steps} steps of {len(data['test'])} test rollouts"
        " (lower is better):"
    )
    metrics: dict[str, float] = {"steps": trainer.step, "training_seconds": trainer.seconds, "tests": len(data["test"])}
    for name, found in errors.items():
        numbers = found.to_metrics()
        print(f"{name:23} position {numbers['position_error']:.4f} m  rotation {numbers['rotation_error']:.4f} rad")
        metrics |= {f"{name}/{key}": value for key, value in numbers.items()}
    if note := cut_short_note(trainer, run.path):
        print(note)
    finish_run(cfg, run, tracker, metrics, checkpoints=[run.checkpoint], step=trainer.step)


if __name__ == "__main__":
    main()
