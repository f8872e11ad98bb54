"""Data sets, and the training data of a forward model: one system or several, variants, and extra trajectories."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torchrl.data import ReplayBuffer, ReplayBufferEnsemble
from tqdm import tqdm

from _common import as_list
from _common.episodes import read_episodes
from torchrl_gn.data import TrajectoryDataset, create_dataset, open_tensors, trajectory_buffer
from torchrl_gn.dynamics import BoundPredictor, ForwardModel
from torchrl_gn.evaluation.errors import HORIZONS
from torchrl_gn.scenes import Scene, has_variants
from torchrl_gn.training import RayCluster, Workers

# Default number of trajectories (paper, SM "Datasets"), and of large models, which are slow to simulate and to train.
_TRAIN, _TRAIN_LARGE, _LARGE = 10_000, 4_000, 16  # degrees of freedom
_ROWS = 256  # trajectories that are checked at a time


HORIZON = max(HORIZONS)
"""Steps of the longest rollouts that recipes measure."""


@contextmanager
def collecting(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar of data collection; yield the callback for ``create_dataset(..., progress=...)``."""
    with tqdm(desc=f"collecting {what}", unit=" trajectories", leave=False) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def check_lengths(data: Mapping[str, Any], horizons: Sequence[int] = ()) -> None:
    """Raise ValueError if trajectories are too short for the errors to measure, over ``horizons`` too."""
    if data["length"] < HORIZON:
        raise ValueError(f"data.length={data['length']} is too short: errors are measured over {HORIZON} steps.")
    if horizons and not 1 <= min(horizons) <= max(horizons) <= data["length"]:
        raise ValueError(
            f"horizons={list(horizons)} must be from 1 to data.length={data['length']}, the steps of a trajectory."
        )


def dataset_with_progress(
    folder: Path, scene: Scene, data: Mapping[str, Any], *, variants: int | None = None
) -> TrajectoryDataset:
    """Create, complete or open the data set ``<name>`` (``<name>_variants``) in ``folder``, with a progress bar.

    ``data`` holds the numbers of ``train``, ``validation`` and ``test`` trajectories, their ``length`` in control
    steps, a ``seed``, and optionally the address ``ray`` of a Ray cluster to simulate on, the ``pace`` of random
    controls and the ``bounds`` of the bodies.
    """
    check_lengths(data)
    name = scene.name if variants is None else f"{scene.name}_variants"
    options: dict[str, Any] = {split: data[split] for split in ("train", "validation", "test")}
    options |= {"steps": data["length"], "seed": data["seed"], "variants": variants, "bounds": data.get("bounds")}
    options["pace"] = data.get("pace", "mixed")
    joined = RayCluster(data["ray"]) if data.get("ray") is not None else nullcontext()
    with collecting(f"data of {scene.name}") as show, joined as cluster:
        if cluster is not None:  # it simulates one chunk per core
            options |= {"map_chunks": cluster.imap, "num_threads": 1}
        return create_dataset(folder / name, scene, **options, progress=show)


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
        """True if the trajectories are of random variants."""
        return "parameters" in self.train.keys()

    def bind(self, model: ForwardModel) -> BoundPredictor:
        """Bind the weights to the scene, or to its variants, whose parameters come with the samples."""
        if not self.parametrized:
            return model.bind(self.scene)
        return model.bind(self.scene, parameters_key="parameters", parameter_names=self.dataset.features)


def make_tasks(cfg: DictConfig, scenes: list[Scene], folder: Path) -> list[Task]:
    """Collect every system's data, or open its existing data set."""
    if cfg.data.extra is not None and (len(scenes) > 1 or cfg.parametrized):
        raise ValueError("data.extra holds trajectories of one system without variants; name that one.")
    tasks = []
    for scene in scenes:
        parametrized = cfg.parametrized and (len(scenes) == 1 or has_variants(scene))
        train = cfg.data.train or _default_count(scene)
        variants = (cfg.data.variants or train) if parametrized else None
        dataset = dataset_with_progress(folder, scene, {**cfg.data, "train": train}, variants=variants)
        tasks.append(Task(scene, dataset, mixture(cfg, dataset)))
    return tasks


def _default_count(scene: Scene) -> int:
    return _TRAIN if "system" in scene.origin or scene.model.nv <= _LARGE else _TRAIN_LARGE


def mixture(cfg: DictConfig, dataset: TrajectoryDataset) -> TensorDictBase:
    """Return half of the training trajectories and as many of `data.extra`, repeated if these are fewer."""
    if cfg.data.extra is None:
        return dataset.train
    count = (len(dataset.train) + 1) // 2
    own = cast(TensorDict, dataset.train[:count]).select("state", "action")
    each = []
    for source in as_list(cfg.data.extra):
        each.append(extra_trajectories(source, cfg.data.length))
        shapes, wanted = ([list(data.get(key).shape[1:]) for key in ("state", "action")] for data in (each[-1], own))
        if shapes != wanted:
            raise ValueError(
                f"data.extra={source} has states and actions [M, *] of shapes {shapes}; {cfg.system} with"
                f" data.length={cfg.data.length} has {wanted}."
            )
    more = each[0] if len(each) == 1 else cast(TensorDict, torch.cat(each))  # a single source stays on disk
    return cast(TensorDictBase, torch.cat([own, more[torch.arange(count) % len(more)].to(own["action"].dtype)]))


def extra_trajectories(source: str, length: int) -> TensorDict:
    """Read trajectories ``[M]`` from a folder, or from a file of recipes/mpc.py's episodes in pieces of `length` steps.

    Raises:
        ValueError: if it holds anything but finite states and actions.
    """
    if not source.endswith(".safetensors"):
        return _whole_trajectories(source)
    records = read_episodes(source)
    episodes, steps = records["action"].shape[:2]
    if steps < length:
        raise ValueError(f"data.extra={source} has episodes of {steps} steps, fewer than data.length={length}.")
    states, actions = (records[name].unfold(1, length + more, length) for name, more in (("state", 1), ("action", 0)))
    pieces = {"state": states.movedim(-1, 2).flatten(0, 1), "action": actions.movedim(-1, 2).flatten(0, 1)}
    # An episode whose simulation became unstable is NaN from there on.
    whole = torch.stack([piece.isfinite().flatten(1).all(1) for piece in pieces.values()]).all(0)
    if not bool(whole.any()):
        raise ValueError(f"data.extra={source} has no {length} steps of an episode that stayed stable.")
    return TensorDict({name: piece[whole] for name, piece in pieces.items()}, [int(whole.sum())])


def _whole_trajectories(folder: str) -> TensorDict:
    try:
        found = open_tensors(folder)
    except ValueError as error:
        raise ValueError(f"data.extra={folder} cannot be read: {error}") from error
    if missing := {"state", "action"} - set(found.keys()):
        raise ValueError(f"data.extra={folder} has no {sorted(missing)}, only {sorted(map(str, found.keys()))}.")
    if found.batch_dims != 1 or not len(found):
        raise ValueError(
            f"data.extra={folder} holds trajectories {list(found.batch_size)}; it must be [M], at least one."
        )
    found = found.select("state", "action")
    for first, rows in enumerate(found.split(_ROWS)):
        for key, values in rows.items():
            if not bool((finite := values.isfinite().flatten(1).all(1)).all()):
                row = _ROWS * first + int(finite.logical_not().nonzero()[0])
                raise ValueError(f"data.extra={folder}: {key} of trajectory {row} is not finite: leave that one out.")
    return found


def make_buffer(
    tasks: list[Task], batch_size: int, window: int, seed: int, workers: Workers, device: torch.device
) -> ReplayBuffer:
    """Make a replay buffer of windows, with equal shares of several systems.

    The data move to a GPU ``device`` if they take less than a third of its free memory.
    """
    share, options = max(1, batch_size // len(tasks)), {"window": window, "shard": workers.shard}
    size = sum(value.numel() * value.element_size() for task in tasks for value in task.train.values(True, True))
    there = device.type == "cuda" and 3 * size < torch.cuda.mem_get_info(device)[0]
    buffers = [
        trajectory_buffer(
            task.train.to(device) if there else task.train, batch_size=share, seed=seed + 1000 * index, **options
        )
        for index, task in enumerate(tasks)
    ]
    if len(buffers) == 1:
        return buffers[0]
    return ReplayBufferEnsemble(*buffers, batch_size=share * len(tasks), sample_from_all=True)
