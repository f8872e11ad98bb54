"""Run time of the forward model: specialised and reference, the same work in turn.

    python recipes/benchmark_speed.py [system=swimmer6] [hidden=[128,128]] [compile=true] [curves=true]

Times one step, rollouts, gradients through rollouts and a training step of one forward model (random weights, true
physical parameters), evaluated in several ways: `reference` (PyG message passing, eager: the baseline), `folded` (what
training uses), `specialised`, and on top of it oneDNN's matrix products (`fast`), bfloat16 products (where this
processor is fast at them) and `torch.compile`. Each way does each piece of work in turn, several times. The table shows
medians, speed-ups over `reference`, peak memory, and errors against the reference in float64. The share of the limit
compares the specialised model's FLOP/s with those of a large matrix product. `curves=true` draws the time of a step
over links, batch sizes and hidden sizes, and of a rollout's gradient over its length. No figure of the paper. Takes
about ten minutes, half of it compiling. Results: docs/performance.md.

Writes config.yaml, metrics.json and with curves the figure speed.png to its run folder.
"""

from __future__ import annotations

import copy
import functools
import statistics
from typing import cast

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from tqdm import tqdm

from _common import clean_exit, finish_run, open_run, with_help
from _common.speed_work import Way, Work, gemm_rate, make_works, peak_memory, pull, step_once, timed, train_work
from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel, Predictor, specialize
from torchrl_gn.evaluation import plot_loglog
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.processor import product_speeds
from torchrl_gn.scenes import load_scene


def make_model(cfg: DictConfig, system: str, hidden: list[int]) -> tuple[ForwardModel, TensorDict]:
    """Random weights with the normalisers of a short collection, and its transitions."""
    scene = load_scene(system)
    trajectories = collect_trajectories(scene, 64, 64, cfg.seed)
    transitions = cast(TensorDict, trajectory_buffer(trajectories, batch_size=64 * 64, seed=cfg.seed).sample())
    torch.manual_seed(cfg.seed)
    edges = hidden if cfg.edge_hidden is None else list(cfg.edge_hidden)
    sizes = {"hidden": hidden, "edge_hidden": edges, "latent": cfg.latent}
    model = ForwardModel.for_scene(scene, activation=cfg.activation, **sizes)
    ForwardModelLoss(model.bind(scene)).fit_normalizers(transitions)
    return model, transitions


def make_ways(cfg: DictConfig, model: ForwardModel, system: str) -> dict[str, Way]:
    """All ways, the baseline first."""
    scene = load_scene(system)
    bound = model.bind(scene)
    ways = {
        "reference": Way(model.bind(scene, reference=True)),
        "reference, fast": Way(model.bind(scene, reference=True), fast=True),
        "folded, fast": Way(bound, fast=True),
        "specialised": Way(specialize(bound)),
        "specialised, fast": Way(specialize(bound), fast=True),
    }
    rounded = product_speeds().pays(torch.bfloat16)
    if rounded:
        ways["specialised, bfloat16"] = Way(specialize(bound, dtype=torch.bfloat16))
    if cfg.compile:
        compiled = specialize(bound, executor="compiled")
        ways["compiled"] = Way(compiled)
        ways["compiled, fast"] = Way(compiled, fast=True)
        if rounded:
            ways["compiled, bfloat16"] = Way(specialize(bound, dtype=torch.bfloat16, executor="compiled"))
    return ways


def measure(works: list[Work], ways: dict[str, Way], reference: Predictor | None) -> dict[str, float]:
    """Time every work in every way, in turn; returns the seconds of first calls of compiled ways."""
    compile_seconds = {}
    bar = tqdm(total=sum(work.repeats + 1 for work in works) * len(ways), desc="measuring", leave=False)
    for work in works:
        expected = None if reference is None else work.run(Way(reference))
        for turn in range(work.repeats + 1):
            for name, way in ways.items():
                result, seconds = timed(functools.partial(work.run, way), way.fast)
                bar.update()
                if turn == 0:  # warms up, compiles
                    if name == "compiled":
                        compile_seconds[work.name] = seconds
                    if result is not None and expected is not None:
                        work.errors[name] = float((result - expected).norm() / expected.norm())
                else:
                    work.milliseconds.setdefault(name, []).append(1e3 * seconds / work.steps)
        for name, way in ways.items():
            work.megabytes[name] = peak_memory(functools.partial(timed, functools.partial(work.run, way), way.fast))
    bar.close()
    return compile_seconds


def limits(cfg: DictConfig, ways: dict[str, Way], work: Work, batch: int) -> dict[str, float]:
    """Share of the limit that each way reaches: FLOPs of the specialised function at the measured product rate."""
    shares = {}
    for name, way in ways.items():
        if not name.startswith(("specialised", "compiled")):
            continue
        quick = way.model
        edges, size = quick.scene.num_edges, cfg.hidden[-1]
        dtype = torch.bfloat16 if "bfloat16" in name else torch.float32
        rate = gemm_rate(batch * edges, size, dtype, way.fast, cfg.repeats)
        flop = 1e3 * quick.skipped()["kFLOP"][1] * batch  # type: ignore[attr-defined]
        shares[name] = flop / rate / (1e-3 * statistics.median(work.milliseconds[name]))
    return shares


def curves(cfg: DictConfig) -> dict[str, dict[str, tuple[list[float], list[float]]]]:
    """Milliseconds of a step against links, batch and hidden size, and of gradients against horizons."""
    panels: dict[str, dict[str, tuple[list[float], list[float]]]] = {}
    points = [("links, batch 100", f"swimmer{links}", 100, 128, links) for links in cfg.curve_links]
    points += [("batch", cfg.system, batch, 128, batch) for batch in cfg.curve_batches]
    points += [("hidden size, batch 100", cfg.system, 100, hidden, hidden) for hidden in cfg.curve_hidden]
    points += [("horizon, batch 100, with gradient", cfg.system, 100, 128, steps) for steps in cfg.curve_horizons]
    for panel, system, batch, hidden, x in tqdm(points, desc="curves", leave=False):
        model, transitions = make_model(cfg, system, [hidden, hidden])
        bound = model.bind(load_scene(system))
        ways = {
            "reference": Way(model.bind(bound.scene, reference=True)),
            "specialised": Way(specialize(bound)),
            "specialised, fast": Way(specialize(bound), fast=True),
        }
        model.requires_grad_(False)
        state, action = transitions["state"][:batch], transitions["action"][:batch]
        for name, way in ways.items():
            if panel.startswith("horizon"):
                run = functools.partial(pull, way.model, state, action.unsqueeze(1).expand(-1, x, -1))
            else:
                run = functools.partial(step_once, way.model, state, action)
            seconds = [timed(run, way.fast)[1] for _ in range(max(4, cfg.repeats // 2))]
            line = panels.setdefault(panel, {}).setdefault(name, ([], []))
            line[0].append(x)
            line[1].append(1e3 * statistics.median(seconds[1:]))
    return panels


@with_help
@hydra.main(config_path="config", config_name="benchmark_speed", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    run, tracker = open_run(cfg, "benchmark_speed")
    model, transitions = make_model(cfg, cfg.system, list(cfg.hidden))
    ways, works = make_ways(cfg, model, cfg.system), make_works(cfg, model, transitions)
    model.requires_grad_(False)
    reference = copy.deepcopy(model).double().bind(load_scene(cfg.system), reference=True)
    compile_seconds = measure(works, ways, reference)
    model.requires_grad_(True)
    training = train_work(cfg, model, transitions)
    measure([training], {name: way for name, way in ways.items() if "reference" in name or "folded" in name}, None)

    print(ways["specialised"].model)
    print(
        f"\nMilliseconds a step, median of {cfg.repeats}, {cfg.threads} threads; speed-up over reference; most MB of"
        " memory; error"
    )
    metrics: dict[str, float | int] = {"threads": cfg.threads}
    for work in [*works, training]:
        print(work.name)
        baseline = statistics.median(work.milliseconds["reference"])
        for name, values in work.milliseconds.items():
            median = statistics.median(values)
            error = f"{work.errors[name]:11.1e}" if name in work.errors else ""
            print(f"  {name:24}{median:10.3f}{baseline / median:8.1f}x{work.megabytes[name]:9.1f}{error}")
            metrics[f"{work.name}/{name}/megabytes"] = work.megabytes[name]
            metrics[f"{work.name}/{name}/milliseconds"] = median
            metrics[f"{work.name}/{name}/speedup"] = baseline / median
            metrics[f"{work.name}/{name}/range"] = (max(values) - min(values)) / median
            if name in work.errors:
                metrics[f"{work.name}/{name}/error"] = work.errors[name]
    batch = max(cfg.batches)
    widest = next(work for work in works if work.name == f"step, batch {batch}")
    print(f"Share of the limit, step, batch {batch}")
    for name, share in limits(cfg, ways, widest, batch).items():
        print(f"  {name:24}{100 * share:10.0f} %")
        metrics[f"limit/{name}"] = share
    for name, seconds in compile_seconds.items():
        metrics[f"first call/{name}"] = seconds
    if compile_seconds:
        print("First calls of the compiled model: " + ", ".join(f"{n} {s:.0f} s" for n, s in compile_seconds.items()))
    if cfg.curves:
        panels = curves(cfg)
        for panel, lines in panels.items():
            for name, (xs, ys) in lines.items():
                metrics.update({f"curve/{panel}/{name}/{x}": y for x, y in zip(xs, ys, strict=True)})
        plot_loglog(panels, run.file("speed.png"), ylabel="milliseconds")
    finish_run(cfg, run, tracker, metrics)


if __name__ == "__main__":
    main()
