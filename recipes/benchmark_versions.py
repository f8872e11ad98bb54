"""Run times of this version and another: the same work of a shipped model by both, in turn.

    python recipes/benchmark_versions.py other=../before [system=swimmer6] [rounds=5]

`other` is a checkout of another version, say of `git worktree add ../before v0.1.0`; both run in this environment, in
processes of their own. Times steps, rollouts and their gradients of the specialised model, rollouts of the bound one,
and training steps, in processor time of one thread. Prints the median of every time over the rounds, and of the ratios
within them: on a shared machine times drift, their ratio within a round less. No figure of the paper. Takes minutes.
Results: docs/results/pure-steps.md.

Writes config.yaml and metrics.json to its run folder.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

HERE = Path(__file__).resolve().parents[1]
PART = "TORCHRL_GN_VERSION"  # set in the processes that are timed: where they leave their times


def works(cfg: DictConfig) -> Iterator[tuple[str, Callable[[], object]]]:
    """Names of the works and what does them once, with what all versions have."""
    from torchrl_gn import collect_trajectories, load_pretrained, specialize
    from torchrl_gn.data import trajectory_buffer
    from torchrl_gn.objectives import ForwardModelLoss
    from torchrl_gn.training import make_optimizer

    model = load_pretrained(cfg.system)
    bound = model.bind(model.scene())
    quick = specialize(bound)
    most = max(*cfg.batches, *cfg.rollout_batches, cfg.live_batch, cfg.training_batch)
    data = collect_trajectories(bound.scene, most, steps=cfg.horizon + 1, seed=cfg.seed)
    states, actions = data["state"][:, 0].contiguous(), data["action"].contiguous()
    for batch in cfg.batches:
        given = states[:batch].clone(), actions[:batch, 0].clone()
        yield f"step, batch {batch}", lambda given=given: quick.step(*given)
    for batch in cfg.rollout_batches:
        given = states[:batch].clone(), actions[:batch, : cfg.horizon].clone()
        yield f"rollout of {cfg.horizon}, batch {batch}", lambda given=given: quick.rollout(*given)

        def pull(given=given) -> None:
            leaf = given[1].detach().requires_grad_()
            quick.rollout(given[0], leaf)[0].sum().backward()

        yield f"gradient of {cfg.horizon}, batch {batch}", pull
    given = states[: cfg.live_batch].clone(), actions[: cfg.live_batch, : cfg.live_horizon].clone()
    for name, predictor in (("specialised", quick), ("live", bound)):

        def roll(predictor=predictor) -> None:
            with torch.no_grad():
                predictor.rollout(*given)

        yield f"{name} rollout of {cfg.live_horizon}, batch {cfg.live_batch}", roll
    loss, optimizer = ForwardModelLoss(bound), make_optimizer(model.model.core)
    batch = trajectory_buffer(data, batch_size=cfg.training_batch, seed=cfg.seed).sample()

    def train() -> None:
        optimizer.zero_grad()
        loss(batch)["loss_forward_model"].backward()
        optimizer.step(0, 1.0)  # the schedule has ended: the weights stay as they are

    yield f"training step, batch {cfg.training_batch}", train


def measure(cfg: DictConfig) -> dict[str, float]:
    """Median milliseconds of a call of every work."""
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    found = {}
    for name, run in works(cfg):
        run()
        run()
        seconds: list[float] = []
        while sum(seconds) < cfg.seconds:
            start = time.thread_time()
            run()
            seconds.append(time.thread_time() - start)
        found[name] = 1e3 * median(seconds)
    return found


def start(cfg: DictConfig, checkout: Path) -> dict[str, float]:
    """The same by the library of a checkout; ValueError if it fails."""
    environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": str(cfg.threads)}
    with TemporaryDirectory() as folder:
        place = Path(folder) / "part.json"
        place.write_text(json.dumps(OmegaConf.to_container(cfg, resolve=True)))
        command = [sys.executable, "-W", "ignore", __file__]
        environment[PART] = str(place)
        done = subprocess.run(command, env=environment, cwd=checkout, capture_output=True, text=True)
        if done.returncode:
            raise ValueError(f"The version in {checkout} failed:\n{done.stderr}")
        times = json.loads(place.read_text())
    if not Path(times.pop("library")).is_relative_to(checkout):
        raise ValueError(f"{checkout} is no checkout of torchrl_gn.")
    return times


def compare(cfg: DictConfig) -> None:
    from _common import finish_run, open_run

    if cfg.rounds < 1:
        raise ValueError(f"rounds={cfg.rounds} must be 1 or more.")
    run, tracker = open_run(cfg, "benchmark_versions")
    versions = {"before": Path(cfg.other).resolve(), "now": HERE}
    found: dict[str, list[dict[str, float]]] = {name: [] for name in versions}
    for name in tqdm([*versions] * cfg.rounds, desc="measuring", leave=False):
        found[name].append(start(cfg, versions[name]))
    metrics: dict[str, float] = {"threads": cfg.threads}
    print(f"{'milliseconds':40}{'before':>10}{'now':>10}{'now / before':>14}")
    for work in found["now"][0]:
        rounds = [(before[work], now[work]) for before, now in zip(found["before"], found["now"], strict=True)]
        before, now = (median(each[index] for each in rounds) for index in (0, 1))
        ratio = median(now / before for before, now in rounds)
        metrics |= {f"{work}/before": before, f"{work}/now": now, f"{work}/ratio": ratio}
        print(f"{work:40}{before:>10.3f}{now:>10.3f}{ratio:>14.2f}")
    finish_run(cfg, run, tracker, metrics)


if __name__ == "__main__":
    if PART in os.environ:  # by the library of PYTHONPATH, without the recipes' own modules, which are of this version
        import torchrl_gn

        part = Path(os.environ[PART])
        times = measure(DictConfig(json.loads(part.read_text())))
        part.write_text(json.dumps({"library": torchrl_gn.__file__, **times}))
    else:
        from _common import clean_exit, with_help

        main = hydra.main(version_base=None, config_path="config", config_name="benchmark_versions")(
            clean_exit(compare)
        )
        with_help(main)()
