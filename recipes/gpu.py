"""Measure what a GPU gains: control steps a second with and without gradients, training time, memory, tests.

    python recipes/gpu.py [parts=[speed]] [systems=[swimmer6]] [batches=[1024]]

The parts are

- `tests`: the tests that need a GPU.
- `speed`: control steps a second of rollouts, forward and with the gradient to start states and actions, by system,
  batch size and executor: `torch` (folded, by torch operations), `native` (state maths in CUDA kernels, steps as CUDA
  graphs), `compiled` (the network through torch.compile too), and the last two with products in TF32 or bfloat16. Also
  the peak memory of each, and the error of a step against float64.
- `parts`: times within a step and its gradient: kernels before and after the network, and the network by torch and by
  torch.compile.
- `cores`: our native executor on this machine's CPU.
- `training`: recipes/forward_model.py with its data, training and evaluation.
- `policy`: returns of recipes/shac.py on the suite's cheetah run, and the seconds of learning and playing until the
  median return of the last five rounds exceeds 519, TD-MPC2's return after 100,000 frames.
- `jraph`: the same network alone in jraph under jax.jit, on the GPU that JAX finds.

Models have random weights and normalisers of a short collection. Takes about eight minutes. Results:
docs/results/gpu.md.

Writes config.yaml, metrics.json, parts.json and the runs of `training` and `policy` to its run folder. parts.json is
written after every part, so that an interrupted run keeps its numbers.
"""

from __future__ import annotations

import functools
import itertools
import re
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from _common import clean_exit, finish_run, open_run, parent, with_help
from _common.parent import run_child
from _gpu_parts import StepParts
from torchrl_gn.atomic import read_json, write_json
from torchrl_gn.cache import keep_inductor_private
from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import BoundPredictor, ForwardModel, SpecializedPredictor, specialize
from torchrl_gn.dynamics.executors.cuda import CudaExecutor
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.processor import usable_cores
from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.training.checkpoint import package_versions

ROOT = Path(__file__).parent.parent
RETURN = 519  # of TD-MPC2, cheetah run, 100,000 frames


def load(name: str) -> Scene:
    """Load a scene by name; humanoid is dm_control's."""
    if name != "humanoid":
        return load_scene(name)
    import dm_control.suite

    return load_scene(str(Path(cast(str, dm_control.suite.__file__)).parent / "humanoid.xml"))


def make_model(cfg: DictConfig, name: str) -> tuple[Scene, ForwardModel, TensorDict]:
    """Return a scene, a model with random weights and normalisers of a short collection, and its transitions."""
    scene = load(name)
    trajectories = collect_trajectories(scene, 32, 32, cfg.seed)
    transitions = cast(TensorDict, trajectory_buffer(trajectories, batch_size=1024, seed=cfg.seed).sample())
    torch.manual_seed(cfg.seed)
    model = ForwardModel.for_scene(scene, hidden=cfg.hidden)
    ForwardModelLoss(model.bind(scene)).fit_normalizers(transitions)
    return scene, model.to(cfg.device).requires_grad_(False), transitions


@contextmanager
def tf32(on: bool) -> Iterator[None]:
    """Let float32 products round their factors to TF32 if ``on``."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if on else "highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def seconds(run: Callable[[], object], repeats: int, device: str) -> float:
    """Return the median seconds of a call after one warm-up."""
    found = []
    for turn in range(repeats + 1):
        start = time.perf_counter()
        run()
        if device == "cuda":
            torch.cuda.synchronize()
        if turn:
            found.append(time.perf_counter() - start)
        if sum(found) > 1:  # slow calls need fewer repeats
            break
    return statistics.median(found)


def draw(transitions: TensorDict, batch: int, steps: int, device: str) -> tuple[Tensor, Tensor]:
    """Return states ``[B, N, 13]`` and actions ``[B, T, A]`` of the collection."""
    rows = torch.arange(batch) % len(transitions)
    several = (torch.arange(batch)[:, None] + torch.arange(steps)) % len(transitions)
    return transitions["state"][rows].to(device), transitions["action"][several].to(device)


def vjp(predictor: SpecializedPredictor, state: Tensor, actions: Tensor) -> tuple[Tensor, ...]:
    """Return the gradients of a rollout's states with respect to its start and its actions."""
    leaves = state.detach().requires_grad_(), actions.detach().requires_grad_()
    return torch.autograd.grad(predictor.rollout(*leaves)[0].sum(), leaves)


def measure_speed(cfg: DictConfig, keep: Callable[[dict], None]) -> dict[str, Any]:
    """Measure control steps a second by system, executor and batch size."""
    out: dict[str, Any] = {}
    for name in cfg.systems:
        scene, model, transitions = make_model(cfg, name)
        bound = model.bind(scene)
        exact = specialize(bound, executor="eager", dtype=torch.float64)
        state, actions = draw(transitions, 256, 1, cfg.device)
        wanted = exact.step(state.double(), actions[:, 0].double())[0] - state
        # Products of each dtype have their own kernels, which take some seconds to compile.
        ways: dict[str, tuple[str, torch.dtype | None, bool]] = {
            "torch": ("eager", None, False),
            "native": ("native", None, False),
            "native, tf32": ("native", None, True),
            "native, bfloat16": ("native", torch.bfloat16, True),
            "compiled": ("compiled", None, False),
            "compiled, tf32": ("compiled", None, True),
            "compiled, bfloat16": ("compiled", torch.bfloat16, True),
        }
        wanted_ways = cfg.ways or list(ways if cfg.device == "cuda" else ("torch", "native"))
        if unknown := [way for way in wanted_ways if way not in ways]:
            raise ValueError(f"ways={unknown} are not known; use any of {list(ways)}.")
        for way in wanted_ways:
            executor, dtype, rounded = ways[way]
            start = time.perf_counter()
            predictor = specialize(bound, executor=executor, dtype=dtype)
            key = f"{name}/{way}"
            with tf32(rounded):
                after = predictor.step(state, actions[:, 0])[0].double() - state
                out[f"{key}/error"] = float((after - wanted).norm() / wanted.norm())
                vjp(predictor, state, actions)
                out[f"{key}/first_seconds"] = time.perf_counter() - start
                out[f"{key}/reason"] = predictor.reason
                for batch in cfg.batches:
                    if way == "torch" and batch > cfg.most_by_torch:
                        continue
                    inputs = draw(transitions, batch, cfg.steps, cfg.device)
                    works: dict[str, Callable[[], object]] = {
                        "forward": functools.partial(predictor.rollout, *inputs),
                        "gradient": functools.partial(vjp, predictor, *inputs),
                    }
                    for work, run in works.items():
                        if cfg.device == "cuda":
                            torch.cuda.empty_cache()
                            torch.cuda.reset_peak_memory_stats()
                        try:
                            took = seconds(run, cfg.repeats, cfg.device)
                        except torch.OutOfMemoryError:
                            out[f"{key}/{batch}/{work}"] = None
                            continue
                        out[f"{key}/{batch}/{work}"] = batch * cfg.steps / took
                        if cfg.device == "cuda":
                            out[f"{key}/{batch}/{work}_gib"] = torch.cuda.max_memory_allocated() / 2**30
                        tqdm.write(f"{key:28} {batch:6} {work:9} {batch * cfg.steps / took:14,.0f} steps/s")
            del predictor
            keep(out)
    return out


def measure_parts(cfg: DictConfig, keep: Callable[[dict], None]) -> dict[str, Any]:
    """Measure milliseconds of the parts of one step and its gradient at the largest batch."""
    out: dict[str, Any] = {}
    for name in cfg.systems[:2] if cfg.device == "cuda" else ():
        for work, run in parts_of(cfg, name).items():
            with tf32(work.endswith("tf32")):
                try:
                    took = seconds(run, cfg.repeats, cfg.device)
                except Exception as error:  # a missing compiler, say
                    out[f"{name}/{work}"] = f"{type(error).__name__}: {error}"[:300]
                    continue
            out[f"{name}/{work}"] = took * 1e3
            tqdm.write(f"{name:12} {work:36} {took * 1e3:10.3f} ms")
        keep(out)
    return out


def parts_of(cfg: DictConfig, name: str) -> dict[str, Callable[[], object]]:
    """Return the parts of a step by name: kernels, and the network by torch and compiled."""
    scene, model, transitions = make_model(cfg, name)
    predictor = specialize(model.bind(scene))
    executor, program = predictor.executor, predictor.program()
    if not isinstance(executor, CudaExecutor) or executor.reason is not None:
        return {}
    state, actions = draw(transitions, max(cfg.batches), 1, cfg.device)
    parts = StepParts(executor, program, state, actions[:, 0].contiguous())
    works: dict[str, Callable[[], object]] = {
        "inputs": parts.inputs,
        "result": parts.result,
        "inputs and gradient": parts.inputs_gradient,
        "result and gradient": parts.result_gradient,
    }
    keep_inductor_private()
    networks = {"network": parts.network, "network compiled": torch.compile(parts.network, dynamic=False)}
    for suffix, (kind, network) in itertools.product(("", ", tf32"), networks.items()):
        works[f"{kind}{suffix}"] = functools.partial(parts.forward, network)
        works[f"{kind} and gradient{suffix}"] = functools.partial(parts.network_gradient, network)
    return works


def measure_cores(cfg: DictConfig, keep: Callable[[dict], None]) -> dict[str, Any]:
    """Measure control steps a second of the native executor on the CPU."""
    out: dict[str, Any] = {"threads": torch.get_num_threads(), "cores": usable_cores()}
    for name in cfg.systems:
        scene, model, transitions = make_model(cfg, name)
        predictor = specialize(cast(BoundPredictor, model.cpu().bind(scene)))
        inputs = draw(transitions, cfg.cores_batch, cfg.steps, "cpu")
        count = cfg.cores_batch * cfg.steps
        out[f"{name}/forward"] = count / seconds(functools.partial(predictor.rollout, *inputs), cfg.repeats, "cpu")
        out[f"{name}/gradient"] = count / seconds(functools.partial(vjp, predictor, *inputs), cfg.repeats, "cpu")
        out[f"{name}/reason"] = predictor.reason
        tqdm.write(f"{name:12} cores {out[f'{name}/forward']:14,.0f} {out[f'{name}/gradient']:14,.0f} steps/s")
        keep(out)
    return out


def run_recipe(cfg: DictConfig, name: str, place: Path, options: Sequence[str]) -> dict[str, Any]:
    """Run a recipe on the device; return its numbers and the seconds of its process, or its output if it failed."""
    place = place.resolve()  # the recipe runs in another folder
    command = [sys.executable, str(ROOT / f"recipes/{name}.py"), f"device={cfg.device}", f"run_dir={place}"]
    start = time.perf_counter()
    done = run_child([*command, f"seed={cfg.seed}", *options], cwd=ROOT)
    out: dict[str, Any] = {"whole_seconds": time.perf_counter() - start}
    if done.returncode:
        tqdm.write(f"{name} failed: {(done.stdout + done.stderr)[-2000:]}")
        return {**out, "failed": (done.stdout + done.stderr)[-2000:]}
    if warned := [line for line in done.stderr.splitlines() if "Warning" in line]:  # updates without graphs, say
        out["warned"] = "\n".join(warned)[:2000]
    metrics = read_json(place / "metrics.json")
    tqdm.write(done.stdout)
    return out | {key: value for key, value in metrics.items() if isinstance(value, (int, float))}


def measure_training(cfg: DictConfig, keep: Callable[[dict], None], folder: Path) -> dict[str, Any]:
    """Measure seconds and errors of recipes/forward_model.py, in a run for each set of options."""
    out: dict[str, Any] = {}
    for index, options in enumerate(cfg.training):
        overrides = [f"data.folder={folder.resolve() / 'data'}", *options.split()]
        numbers = run_recipe(cfg, "forward_model", folder / f"training{index}", overrides)
        out |= {f"{options}/{key}": value for key, value in numbers.items()}
        keep(out)
    return out


def measure_policy(cfg: DictConfig, keep: Callable[[dict], None], folder: Path) -> dict[str, Any]:
    """Measure returns of recipes/shac.py, in a run for each set of options, and when they exceed TD-MPC2's."""
    out: dict[str, Any] = {}
    for index, options in enumerate(cfg.policy):
        overrides = options.split()
        numbers = run_recipe(cfg, "shac", folder / f"policy{index}", overrides)
        rounds, key = itertools.count(), "round {}/median_return_of_last_five"
        medians = itertools.takewhile(
            lambda each: each is not None, (numbers.get(key.format(number)) for number in rounds)
        )
        above = next((number for number, median in enumerate(medians) if cast(float, median) > RETURN), None)
        for name in ("seconds", "frames"):
            numbers[f"{name}_to_{RETURN}"] = None if above is None else numbers[f"round {above}/{name}"]
        out |= {f"{options}/{key}": value for key, value in numbers.items()}
        keep(out)
    return out


def measure_jraph(cfg: DictConfig, keep: Callable[[dict], None]) -> dict[str, Any]:
    """Measure control steps a second of the network alone in jraph by batch size."""
    out: dict[str, Any] = {}
    for name, batch in itertools.product(cfg.systems[:1], list(cfg.batches)[-2:]):
        scene, model, transitions = make_model(cfg, name)
        state, actions = draw(transitions, batch, 1, "cpu")
        try:
            from _common.jraph_network import JraphBaseline

            jraph = JraphBaseline(model.cpu(), scene, usable_cores())
            runs = {"forward": jraph.step(state, actions[:, 0]), "gradient": jraph.gradient(state, actions[:, 0])}
        except Exception as error:
            out[f"{name}/{batch}/failed"] = f"{type(error).__name__}: {error}"[:300]
            continue
        for work, run in runs.items():
            out[f"{name}/{batch}/{work}"] = batch / seconds(run, cfg.repeats, "cpu")
        keep(out)
    return out


def run_tests(cfg: DictConfig) -> dict[str, Any]:
    """Run the tests that need a GPU; return their outcome."""
    command = [sys.executable, parent.__file__, "pytest", "-q", "-p", "no:cacheprovider", "-m", "gpu", *cfg.test_files]
    done = run_child(command, cwd=ROOT)
    lines = done.stdout.strip().splitlines()
    return {"passed": done.returncode == 0, "last": lines[-1] if lines else "", "output": done.stdout[-6000:]}


def machine(cfg: DictConfig) -> dict[str, Any]:
    """Return names and versions of the machine and its packages."""
    out: dict[str, Any] = {"cores": usable_cores(), **package_versions()}
    if cfg.device == "cuda":
        properties = torch.cuda.get_device_properties(0)
        out |= {"gpu": properties.name, "memory_gib": properties.total_memory / 2**30, "cuda": torch.version.cuda}
    return out


@with_help
@hydra.main(config_path="config", config_name="gpu", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    if cfg.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("device=cuda needs a GPU and a torch built for it; device=cpu tries the script.")
    run, tracker = open_run(cfg, "gpu")
    metrics: dict[str, Any] = {f"machine/{key}": value for key, value in machine(cfg).items()}
    works: dict[str, Callable[[Callable[[dict], None]], dict[str, Any]]] = {
        "tests": lambda keep: run_tests(cfg),
        "speed": lambda keep: measure_speed(cfg, keep),
        "parts": lambda keep: measure_parts(cfg, keep),
        "cores": lambda keep: measure_cores(cfg, keep),
        "training": lambda keep: measure_training(cfg, keep, run.path),
        "policy": lambda keep: measure_policy(cfg, keep, run.path),
        "jraph": lambda keep: measure_jraph(cfg, keep),
    }
    if unknown := [part for part in cfg.parts if part not in works]:
        raise ValueError(f"parts={unknown} are not known; use any of {list(works)}.")
    for part in cfg.parts:
        start = time.perf_counter()

        def keep(found: dict[str, Any], part: str = part) -> None:
            metrics.update({f"{part}/{key}": value for key, value in found.items()})
            write_json(run.path / "parts.json", metrics)

        try:
            keep(works[part](keep))
        except Exception as error:  # continue with the other parts
            metrics[f"{part}/failed"] = f"{type(error).__name__}: {error}"[:2000]
            tqdm.write(f"{part} failed: {metrics[f'{part}/failed']}")
        keep({"seconds": time.perf_counter() - start})
    numbers = {
        re.sub(r"[^\w/.]+", "_", key): value for key, value in metrics.items() if isinstance(value, (int, float))
    }
    finish_run(cfg, run, tracker, numbers, files=[run.path / "parts.json"])


if __name__ == "__main__":
    main()
