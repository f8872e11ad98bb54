"""Identify parameters of a MuJoCo model from trajectories, with their uncertainty, and compare with mujoco.sysid.

    python recipes/identify_parameters.py [system=arm] [parameters=[dof_armature]] [noise=[0.001, 0.02]]
                                          [actuator_delay=0.013]

Simulates robots whose parameters are the model's times random factors. identify_parameters() starts from the model's
values, estimates the true ones from noisy states, and states its uncertainty. With actuator_delay=, all commands of the
robots act that many seconds late, and the delay is estimated, too. For the arm of mujoco.sysid's own test (five hinges,
two seconds of sine waves), mujoco.sysid estimates the same, if it is installed (MuJoCo 3.5 or newer,
`pip install mujoco[sysid]`). Beyond the paper.

Writes config.yaml and metrics.json to its run folder. All options: recipes/config/identify_parameters.yaml. Results:
docs/results/identified-parameters.md.
"""

from __future__ import annotations

import statistics
import time
from typing import Any, cast

import hydra
import mujoco
import numpy as np
import torch
from mujoco import rollout
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from _common import as_list, clean_exit, finish_run, load_system, open_log, with_help
from torchrl_gn.checks import check_count
from torchrl_gn.data import Simulator, collect_trajectories
from torchrl_gn.scenes import Scene, load_scene, with_factors
from torchrl_gn.training import RunFolder, identify_parameters, parameter_names

TIMESTEP, SECONDS = 0.002, 2.0
_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
LABELS = {
    "relative error": "relative error, root mean square",
    "within one": "share within one stated std (ideal: 0.68)",
    "within two": "share within two stated std (ideal: 0.95)",
    "delay error": "delay: error, root mean square (s)",
    "largest delay error": "delay: largest error (s)",
    "stated delay error": "delay: stated error (s)",
    "delay within one": "delay: share within one stated std (ideal: 0.68)",
    "delay within two": "delay: share within two stated std (ideal: 0.95)",
    "seconds": "seconds for a robot",
}
"""Names of metrics in the printed table."""
ARMATURES = (0.5, 0.4, 0.3, 0.2, 0.1)
# Links of the arm of mujoco.sysid's test: length, mass, inertia, centre of mass, damping, axis.
LINKS = (
    (0.1, 1.0, (0.01, 0.01, 0.005), 0.05, 1.0, "0 0 1"),
    (0.1, 0.8, (0.008, 0.008, 0.004), 0.05, 0.8, "0 1 0"),
    (0.1, 0.6, (0.006, 0.006, 0.003), 0.05, 0.6, "0 1 0"),
    (0.08, 0.4, (0.004, 0.004, 0.002), 0.04, 0.4, "0 0 1"),
    (0.06, 0.2, (0.002, 0.002, 0.001), 0.03, 0.2, "0 1 0"),
)
WAVES = ((5.0, 0.5, 0.0), (4.0, 0.7, 0.5), (3.0, 0.4, 1.0), (2.0, 0.9, 1.5), (1.0, 0.6, 2.0))  # N m, Hz, phase


def arm_mjcf(armatures: tuple[float, ...], delay: float = 0.0) -> str:
    """Return the MJCF of the arm, whose motors act ``delay`` seconds late."""
    bodies, height = "", 0.1
    for number, ((length, mass, inertia, centre, damping, axis), armature) in enumerate(
        zip(LINKS, armatures, strict=True), 1
    ):
        bodies += f"""<body name="link{number}" pos="0 0 {height}">
            <inertial pos="0 0 {centre}" mass="{mass}" diaginertia="{" ".join(map(str, inertia))}"/>
            <joint name="joint{number}" type="hinge" axis="{axis}" range="-3.14 3.14" armature="{armature}"
                damping="{damping}"/>
            <geom type="capsule" fromto="0 0 0 0 0 {length}" size="0.03"/>"""
        height = length
    names = [f"joint{number}" for number in range(1, len(LINKS) + 1)]
    late = f' delay="{delay}" nsample="{round(delay / TIMESTEP) + 2}" interp="linear"' if delay else ""
    motors = "".join(f'<motor name="motor_{name}" joint="{name}" ctrlrange="-10 10"{late}/>' for name in names)
    sensors = "".join(
        f'<joint{kind} name="{name}_{kind}" joint="{name}"/>' for kind in ("pos", "vel") for name in names
    )
    return f"""<mujoco model="arm"><compiler angle="radian" autolimits="true"/>
        <option integrator="implicitfast" timestep="{TIMESTEP}"><flag contact="disable"/></option>
        <worldbody>{bodies}{"</body>" * len(LINKS)}</worldbody>
        <actuator>{motors}</actuator><sensor>{sensors}</sensor></mujoco>"""


def arm_trajectory(scene: Scene) -> TensorDict:
    """Return the arm's start and the actions of its trajectory, sine waves."""
    times = TIMESTEP * np.arange(round(SECONDS / TIMESTEP))
    controls = np.stack([size * np.sin(2 * np.pi * rate * times + phase) for size, rate, phase in WAVES], -1)[None]
    return TensorDict({"physics": torch.zeros(1, 1, scene.physics_size), "action": torch.from_numpy(controls)}, [1])


def simulated(scene: Scene, trajectories: TensorDict, delay: float) -> TensorDict:
    """Simulate the trajectories' starts and actions, with commands that act ``delay`` seconds late, before them 0.

    A command that changes within a physics step acts as its mean over the step.
    """
    action = cast(Tensor, trajectories["action"]).double()
    whole, part = divmod(delay / scene.model.opt.timestep, 1.0)
    before = action.new_zeros(len(action), int(whole) + 1, action.shape[-1])
    given = torch.cat((before, action.repeat_interleave(scene.substeps, dim=1)), dim=1)
    count = action.shape[1] * scene.substeps
    acting = (1 - part) * given[:, 1 : 1 + count] + part * given[:, :count]
    start = cast(Tensor, trajectories["physics"])[:, 0].double()
    result = Simulator(scene).rollout(start, acting.unflatten(1, (-1, scene.substeps)))
    return TensorDict({**result.select("state", "physics"), "action": action}, trajectories.shape)


def with_noise(scene: Scene, trajectories: TensorDict, noise: tuple[float, float], rng: np.random.Generator):
    """Return the trajectories with measurement noise on joint coordinates (m, rad) and rates."""
    physics, model = cast(Tensor, trajectories["physics"]).numpy().copy(), scene.model
    rates = slice(1 + model.nq, 1 + model.nq + model.nv)
    for row in physics.reshape(-1, physics.shape[-1]):
        position = row[1 : 1 + model.nq].copy()
        mujoco.mj_integratePos(model, position, noise[0] * rng.standard_normal(model.nv), 1.0)
        row[1 : 1 + model.nq] = position
    physics[..., rates] += noise[1] * rng.standard_normal(physics[..., rates].shape)
    measured = {"state": Simulator(scene).observe(physics), "physics": torch.from_numpy(physics)}
    return TensorDict({**measured, "action": trajectories["action"]}, trajectories.shape)


def by_sysid(
    controls: np.ndarray, noise: tuple[float, float], delay: float | None, rng: np.random.Generator
) -> np.ndarray:
    """Estimate the arm's armatures by mujoco.sysid, starting at 0.01 and bounded by 0.001 and 1, as in its test.

    It reads the arm's joint sensors under controls ``[T, A]``, with noise, and knows the start state. Unless ``delay``
    is None, it estimates that, too, as the last number: of the sensors, which is the same here, from 0 to 0.1 s.
    """
    from mujoco import sysid

    spec = mujoco.MjSpec.from_string(arm_mjcf(ARMATURES))
    model, late = spec.compile(), mujoco.MjModel.from_xml_string(arm_mjcf(ARMATURES, delay or 0.0))
    data = mujoco.MjData(model)
    start = sysid.create_initial_state(model, data.qpos, data.qvel, data.act)
    state, data = np.empty(mujoco.mj_stateSize(late, _PHYSICS)), mujoco.MjData(late)
    mujoco.mj_getState(late, data, state, _PHYSICS)
    states, sensors = (each[0] for each in rollout.rollout(late, data, state, controls[:-1]))
    sensors = sensors + np.repeat(noise, model.nv) * rng.standard_normal(sensors.shape)
    seen = sysid.TimeSeries.from_names(states[:, 0], sensors, model)
    inputs = sysid.TimeSeries(TIMESTEP * np.arange(len(controls)), controls)
    found = sysid.ParameterDict()
    for number in range(1, len(LINKS) + 1):
        name = f"joint{number}"

        def change(spec: Any, parameter: Any, name: str = name) -> None:
            spec.joint(name).armature = parameter.value[0]

        found.add(sysid.Parameter(name, nominal=0.5, min_value=0.001, max_value=1.0, modifier=change))
        found[name].value[:] = 0.01
    sequences, options = sysid.ModelSequences("arm", spec, "sines", start, inputs, seen), {}
    if delay is not None:
        found.add(sysid.Parameter("delay", nominal=0.0, min_value=0.0, max_value=0.1))
        transform = sysid.SignalTransform()
        transform.delay("*", found["delay"])
        options = {"modify_residual": transform.apply}
    residual = sysid.build_residual_fn(models_sequences=[sequences], **options)
    best, _ = sysid.optimize(initial_params=found, residual_fn=residual, optimizer="mujoco", verbose=False)
    names = [f"joint{number}" for number in range(1, len(LINKS) + 1)] + ["delay"] * (delay is not None)
    return np.array([best[name].value[0] for name in names])


def chosen_parameters(names: list[str]) -> dict[str, list[str] | None]:
    """Return names by array: ``"dof_armature"`` stands for all, ``"body_mass torso"`` for one."""
    found: dict[str, list[str] | None] = {}
    for each in names:
        array, _, name = each.partition(" ")
        found[array] = [*(found.get(array) or []), name] if name else None
    return found


def has_sysid() -> bool:
    """Return True if mujoco.sysid and its dependencies are installed."""
    try:
        from mujoco import sysid
    except ImportError:
        return False
    return hasattr(sysid, "optimize")


def summarize(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Summarise errors, coverage and seconds over the robots."""
    metrics = {}
    for each, off, std in (("relative", "off", "std"), ("delay", "delay_off", "delay_std")):
        metrics |= of_errors(each, *(np.stack([row[name] for row in rows]) for name in (off, std)))
    metrics["seconds"] = statistics.median(row["seconds"] for row in rows)
    if "sysid" in rows[0]:
        other = np.stack([row["sysid"] for row in rows])
        for each, off in (("relative", other[:, : len(LINKS)]), ("delay", other[:, len(LINKS) :])):
            if off.size:
                metrics[f"mujoco.sysid/{each} error"] = float(np.sqrt(np.mean(np.square(off))))
                metrics[f"mujoco.sysid/largest {each} error"] = float(np.abs(off).max())
        metrics["mujoco.sysid/seconds"] = statistics.median(row["sysid_seconds"] for row in rows)
    return metrics


def of_errors(name: str, off: np.ndarray, std: np.ndarray) -> dict[str, float]:
    """Return metrics of errors and their stated standard deviations ``[robots, P]``; none of no parameters."""
    within = "delay within" if name == "delay" else "within"
    if not off.size:
        return {}
    return {
        f"{name} error": float(np.sqrt(np.mean(np.square(off)))),
        f"largest {name} error": float(np.abs(off).max()),
        f"stated {name} error": float(np.sqrt(np.mean(np.square(std)))),
        f"{within} one": float((np.abs(off) <= std).mean()),
        f"{within} two": float((np.abs(off) <= 2 * std).mean()),
    }


@with_help
@hydra.main(version_base=None, config_path="config", config_name="identify_parameters")
@clean_exit
def main(cfg: DictConfig) -> None:
    check_count("robots", cfg.robots, 1)
    torch.set_num_threads(cfg.threads)
    arm = cfg.system == "arm"
    scene = load_scene(arm_mjcf((0.01,) * len(LINKS)), timestep=TIMESTEP) if arm else load_system(cfg, cfg.system)
    run = RunFolder(cfg.run_dir, "identify_parameters")
    tracker = open_log(cfg, run, label=f"identify-{scene.name}")
    options = {"window": cfg.window, "fit_starts": cfg.fit_starts, "num_threads": cfg.threads, "seed": cfg.seed}
    numbers, noise = chosen_parameters(as_list(cfg.parameters)), (float(cfg.noise[0]), float(cfg.noise[1]))
    delay = None if cfg.actuator_delay is None else float(cfg.actuator_delay)
    if delay is not None and not 0 <= delay < np.inf:
        raise ValueError(f"actuator_delay={delay} must be seconds, at least 0.")
    late = numbers.pop("actuator_delay", [scene.actuator_names])
    chosen = numbers if delay is None else {**numbers, "actuator_delay": late}
    rng = np.random.default_rng(cfg.seed)
    names = parameter_names(scene, chosen)
    count = len(parameter_names(scene, numbers))
    rows: list[dict[str, Any]] = []
    for robot in tqdm(range(cfg.robots), desc="robots", leave=False):
        factors = np.exp(rng.uniform(-1, 1, count) * np.log(cfg.factor))
        if arm:
            factors = np.array(ARMATURES) / 0.01
        true = with_factors(scene, numbers, factors)
        if arm:
            played = arm_trajectory(true)
        else:
            played = collect_trajectories(true, cfg.trajectories, cfg.steps, seed=cfg.seed + robot, split=0)
        if arm or delay:
            played = simulated(true, played, delay or 0.0)
        measured = with_noise(scene, played, noise, rng)
        start = time.perf_counter()
        found = identify_parameters(scene, measured, chosen, **options)
        row = {"seconds": time.perf_counter() - start}
        row |= {"off": np.log(found.factor[:count] / factors), "std": found.std[:count]}
        row |= {"delay_off": found.value[count:] - (delay or 0.0), "delay_std": found.std[count:]}
        if arm and has_sysid():
            start = time.perf_counter()
            other = by_sysid(cast(Tensor, measured["action"])[0].numpy(), noise, delay, rng)
            row["sysid"] = np.append(np.log(other[: len(LINKS)] / ARMATURES), other[len(LINKS) :] - (delay or 0.0))
            row["sysid_seconds"] = time.perf_counter() - start
        rows.append(row)
    metrics = summarize(rows)
    print(
        f"{scene.name}: errors of {len(names)} parameters of {cfg.robots} robots (lower is better). Noise:"
        f" {noise[0]:g} m or rad in positions, {noise[1]:g} in rates"
    )
    for name, value in metrics.items():
        print(f"  {LABELS.get(name, name):50}{value:.4g}")
    finish_run(cfg, run, tracker, metrics, step=cfg.robots)


if __name__ == "__main__":
    main()
