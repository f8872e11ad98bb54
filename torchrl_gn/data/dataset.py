"""Data sets of random trajectories on disk (paper, SM "Datasets")."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from operator import index
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_gn.checks import check_counts, checked_seed
from torchrl_gn.data.collect import CHUNK, check_bounds, collect_chunk, variant_parameters
from torchrl_gn.data.controls import check_knot_interval
from torchrl_gn.data.dataset_files import SPLITS, DatasetFiles, simulation_versions
from torchrl_gn.data.random_controls import Pace, check_pace
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.data.uncontrolled import warn_if_uncontrolled
from torchrl_gn.scenes.articulation import require_bodies
from torchrl_gn.scenes.keyframes import reference_keyframe
from torchrl_gn.scenes.load import scene_from_description
from torchrl_gn.scenes.physical_parameters import ParameterNames, take_columns
from torchrl_gn.scenes.scene import Scene
from torchrl_gn.scenes.variants import make_variants, parameter_ranges, sample_parameters

_DRAWS = 3  # version of how start states and controls of MJCF models are drawn


@dataclass(frozen=True)
class TrajectoryDataset:
    """Trajectories of a scene under random control, in three splits.

    Each split is a TensorDict ``[M]`` like those of :func:`~torchrl_gn.data.collect_trajectories`. With variants it
    also has ``variant_parameters`` ``[M, P]``, in the order of :func:`~torchrl_gn.scenes.parameter_ranges`. Splits are
    mapped from disk; writing to them never changes the files.
    """

    scene: Scene  # the standard scene, if the data have variants
    train: TensorDict
    validation: TensorDict
    test: TensorDict
    rejected: dict[str, int]  # number of redrawn simulations by split
    manifest: dict = field(repr=False)  # seed, steps, package versions, checksums
    features: ParameterNames | None = field(default=None, repr=False)  # columns of ``parameters``, for binding a model

    def scene_of(self, split: str, index: int) -> Scene:
        """Return the scene of one sequence of a split, rebuilt if it is a variant."""
        if split not in SPLITS:
            raise ValueError(f"split={split!r} is not known; use one of {list(SPLITS)}.")
        parameters = getattr(self, split).get("variant_parameters", None)
        return self.scene if parameters is None else _variants(self.scene, parameters[index, None].numpy())[0]


def create_dataset(
    path: str | os.PathLike,
    scene: Scene,
    train: int = 10_000,
    validation: int = 1_000,
    test: int = 1_000,
    steps: int = 100,
    seed: int = 0,
    *,
    variants: int | None = None,
    knot_interval: float = 10.0,
    pace: Pace = "mixed",
    bounds: Mapping[str, float] | None = None,
    num_threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    map_chunks: Callable[[Callable, Iterable], Iterable] = map,
) -> TrajectoryDataset:
    """Create a data set on disk, or finish or load an existing one; the default sizes are the paper's.

    After an interruption the same call continues, with bitwise equal results. Other processes wait for the first.

    Args:
        variants: number of random variants per split, which its sequences take in turn; splits share none.
            Default: the scene itself in all sequences. The paper does not give the number.
        knot_interval, pace, bounds: see :func:`~torchrl_gn.data.collect_trajectories`.
        progress: called after every chunk with the numbers of finished and requested sequences.
        map_chunks: replacement for ``map``: ``imap`` of a pool or of a :class:`~torchrl_gn.training.RayCluster`.

    Raises:
        DatasetError: the folder holds other files, or another or a damaged data set; nothing in it is changed.
        UnstableSimulationError: see :func:`~torchrl_gn.data.collect_trajectories`.
    """
    require_bodies(scene, "A data set")
    sizes = dict(zip(SPLITS, (train, validation, test), strict=True))
    check_counts(**sizes, steps=steps, **({} if variants is None else {"variants": variants}))
    sizes = {name: int(value) for name, value in sizes.items()}
    check_knot_interval(knot_interval)
    check_pace(pace)
    check_bounds(bounds)
    ranges = {} if variants is None else parameter_ranges(_system(scene))
    files = DatasetFiles(Path(path))
    request = {
        "scene": scene.name,
        "fingerprint": scene.fingerprint(),
        "sizes": sizes,
        "steps": index(steps),
        "seed": checked_seed(seed),
        "knot_interval": float(knot_interval),
        "chunk": CHUNK,
        "variants": None if variants is None else index(variants),
        "parameters": {name: [one.low, one.high] for name, one in ranges.items()},
    }
    if "system" not in scene.origin:
        request["draws"] = _DRAWS
        request["keyframe"] = _keyframe(scene)
    if scene.wide_starts != 0.5:
        request["wide_starts"] = scene.wide_starts
    if pace != "mixed":
        request["pace"] = pace
    if bounds:
        request["bounds"] = {name: float(value) for name, value in bounds.items()}
    with files.lock():
        if not files.find(request):
            features = None if variants is None else asdict(ParameterNames.of(scene))
            described = scene.description() if scene.origin else None  # None if made from an MjSpec
            files.create(request=request, description=described, features=features, versions=simulation_versions())
        if not files.is_complete():
            warn_if_uncontrolled(Simulator(scene, 1), stacklevel=2)
            _collect_missing(files, scene, num_threads, progress, map_chunks)
    return _open(files, scene, checksums=False)


def load_dataset(path: str | os.PathLike, scene: Scene | None = None, *, verify: bool = True) -> TrajectoryDataset:
    """Open a finished data set.

    Args:
        scene: expected scene of the data; default: rebuild the scene they were made with.
        verify: compare every file with its checksums.

    Raises:
        DatasetError: the data set is missing, unfinished, damaged, or of another scene or format version.
    """
    files = DatasetFiles(Path(path))
    files.read()
    manifest, request = files.manifest, files.manifest["request"]
    if not files.is_complete():
        done = {split: len(chunks) for split, chunks in manifest["chunks"].items()}
        raise files.error(f"unfinished (chunks done: {done}). Finish it with create_dataset and the same arguments.")
    if scene is None:
        if manifest["description"] is None:
            raise files.error(f"scene {request['scene']!r} is of an MjSpec. Pass it as load_dataset(path, scene).")
        scene = require_bodies(scene_from_description(manifest["description"]), "A data set")
    elif scene.fingerprint() != request["fingerprint"]:
        raise files.error(
            f"the data set is of scene {request['scene']!r} ({request['fingerprint']}), not of {scene.name!r}"
            f" ({scene.fingerprint()}). Load that scene's data set, or create one in another folder."
        )
    return _open(files, scene, checksums=verify)


def _collect_missing(
    files: DatasetFiles,
    scene: Scene,
    num_threads: int | None,
    progress: Callable[[int, int], None] | None,
    map_chunks: Callable[[Callable, Iterable], Iterable],
) -> None:
    request, versions = files.manifest["request"], simulation_versions()
    if files.manifest["versions"] != versions:
        raise files.error(
            f"the data set was started with {files.manifest['versions']} and would go on differently with {versions}."
            " Finish it with those versions, or use another folder."
        )
    stored, names = _stored_features(files), ParameterNames.of(scene)
    if stored and (missing := stored.missing_in(names)):
        raise files.error(
            f"the data set was started with static features {missing}, which this version of torchrl_gn does not have."
            " Finish it with that version, or use another folder."
        )
    chunks = list(_missing_chunks(files, scene))
    collect = partial(_collect, scene, request, num_threads)
    for (key, *_), (rows, rejected) in zip(chunks, map_chunks(collect, chunks), strict=True):
        if stored:
            _take_columns(rows, stored.columns_in(names))
        files.append(SPLITS[key[0]], rows, rejected)
        if progress is not None:
            progress(sum(map(files.rows_done, SPLITS)), sum(request["sizes"].values()))


def _missing_chunks(files: DatasetFiles, scene: Scene) -> Iterator[tuple]:
    """Yield seed key, number of sequences and, for variants, parameters of each unfinished chunk."""
    request = files.manifest["request"]
    for number, (split, size) in enumerate(request["sizes"].items()):
        parameters = None
        if request["variants"] is not None:
            rng = np.random.default_rng(np.random.SeedSequence(request["seed"], spawn_key=(number,)))
            parameters = sample_parameters(_system(scene), min(request["variants"], size), rng)
        for first in range(files.rows_done(split), size, CHUNK):
            rows = np.arange(first, min(first + CHUNK, size))
            chunk_parameters = None if parameters is None else parameters[rows % len(parameters)]
            yield (number, first // CHUNK), len(rows), chunk_parameters


def _collect(scene: Scene, request: dict, num_threads: int | None, chunk: tuple) -> tuple[TensorDict, int]:
    """Simulate a chunk, here or in another process."""
    key, count, parameters = chunk
    scenes, variant = [scene], np.zeros(count, dtype=np.int64)
    if parameters is not None:
        # Built chunk by chunk: thousands of models at once would take gigabytes.
        distinct, variant = np.unique(parameters, axis=0, return_inverse=True)
        scenes, variant = _variants(scene, distinct), variant.reshape(-1)  # some versions of NumPy keep the axis
    options = {name: request[name] for name in ("steps", "seed", "knot_interval")}
    options |= {"bounds": request.get("bounds"), "pace": request.get("pace", "mixed")}
    rows, rejected = collect_chunk(Simulator(scenes, num_threads), variant, key=key, **options)
    if parameters is not None:
        rows["parameters"] = variant_parameters(scenes, variant)
        rows["variant_parameters"] = torch.from_numpy(parameters)
    return rows, sum(rejected.values())


def _keyframe(scene: Scene) -> str | None:
    """Return a hash of the keyframe that start states and controls are drawn around; None without keyframes."""
    key = reference_keyframe(scene.model)
    if key is None:
        return None
    numbers = (getattr(scene.model, f"key_{name}")[key] for name in ("qpos", "act", "ctrl"))
    return hashlib.sha256(",".join(f"{each:.6g}" for each in np.concatenate(list(numbers))).encode()).hexdigest()[:16]


def _system(scene: Scene) -> str:
    if "parameters" in scene.origin:
        raise ValueError(f"Scene {scene.name!r} is a variant already; give the standard system, without parameters.")
    if "system" not in scene.origin:
        raise ValueError(
            f"Scene {scene.name!r} is an MJCF model, which has no parameters to vary; give a system of"
            " torchrl_gn.scenes.parameter_ranges, or pass your own variants to collect_trajectories."
        )
    return scene.origin["system"]


def _variants(scene: Scene, parameters: np.ndarray) -> list[Scene]:
    return make_variants(_system(scene), parameters, timestep=scene.timestep, name=scene.name)


def _open(files: DatasetFiles, scene: Scene, *, checksums: bool) -> TrajectoryDataset:
    features = None
    rejected = {split: sum(each["rejected"] for each in chunks) for split, chunks in files.manifest["chunks"].items()}
    splits = {split: files.open(split, checksums=checksums) for split in SPLITS}
    if stored := _stored_features(files):
        features = ParameterNames.of(scene).common(stored)  # in the order of newly collected samples
        for data in splits.values():
            _take_columns(data, features.columns_in(stored))
    return TrajectoryDataset(scene=scene, rejected=rejected, manifest=files.manifest, features=features, **splits)


def _stored_features(files: DatasetFiles) -> ParameterNames | None:
    names = files.manifest["features"]
    return None if names is None else ParameterNames.from_names(names)


def _take_columns(data: TensorDict, columns: dict[str, list[int]]) -> None:
    """Select columns of the static features in place; features whose columns are in order stay mapped from disk."""
    for part, column_indices in columns.items():
        values = data["parameters", part]
        if column_indices != list(range(values.shape[-1])):
            data["parameters", part] = take_columns(values, column_indices)
