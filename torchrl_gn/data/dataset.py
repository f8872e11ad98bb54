"""Data sets of random trajectories on disk (paper, SM "Datasets")."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from operator import index
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_gn.data.collect import CHUNK, collect_chunk, collect_trajectories, variant_parameters
from torchrl_gn.data.controls import check_knot_interval
from torchrl_gn.data.dataset_files import FORMAT, SPLITS, DatasetFiles, simulation_versions
from torchrl_gn.data.errors import DatasetError
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.scenes.errors import SceneError
from torchrl_gn.scenes.load import scene_from_description
from torchrl_gn.scenes.parameter_names import ParameterNames, take_columns
from torchrl_gn.scenes.physical_parameters import PhysicalParameters
from torchrl_gn.scenes.scene import Scene
from torchrl_gn.scenes.variants import make_variants, parameter_ranges, sample_parameters

__all__ = ["TrajectoryDataset", "collect_trajectories", "create_dataset", "load_dataset"]


@dataclass(frozen=True)
class TrajectoryDataset:
    """Trajectories of a scene under random control, in three splits.

    Each split is a TensorDict ``[M]``, float64: ``state`` ``[M, T+1, N, 13]``, ``action`` ``[M, T, A]`` and
    ``physics`` ``[M, T+1, S]``; of variants also ``parameters``, a TensorDict ``[M]`` of the entries of
    :class:`~torchrl_gn.scenes.PhysicalParameters`, and ``parameters`` ``[M, P]``, in the order of
    :func:`~torchrl_gn.scenes.parameter_ranges`. They are mapped from disk, read when needed; writing to them
    changes memory only, never the files.

    Attributes:
        scene: the scene; of variants, the standard one.
        train: sequences to train on.
        validation: sequences to stop early on.
        test: sequences to report errors on.
        rejected: for each split, how many simulations were unstable and drawn again.
        manifest: the data set's manifest: seed, steps, package versions, checksums.
        features: names of the static features in ``parameters``, for :meth:`ForwardModel.bind
            <torchrl_gn.dynamics.ForwardModel.bind>`: those of this version of the library, in its order, that the data
            set was made with; None if it is not of variants.
    """

    scene: Scene
    train: TensorDict
    validation: TensorDict
    test: TensorDict
    rejected: dict[str, int]
    manifest: dict = field(repr=False)
    features: ParameterNames | None = field(default=None, repr=False)

    def scene_of(self, split: str, index: int) -> Scene:
        """The scene of one sequence, built again if it is a variant.

        Args:
            split: ``"train"``, ``"validation"`` or ``"test"``.
            index: which sequence of it.
        """
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
    num_threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    map_chunks: Callable[[Callable, Iterable], Iterable] = map,
) -> TrajectoryDataset:
    """Simulate a data set onto disk, or finish or load the one that is there.

    The default sizes are the paper's. Data depend on the scene, sizes, ``steps``, ``seed``, ``variants``
    and ``knot_interval`` alone. They are written in chunks; after an interruption the same call goes on
    where it stopped and gives the same bits. Of several processes that want one data set at a time the
    first makes it and the others wait. Splits have independent seeds. Unstable simulations
    are drawn again and counted.

    Args:
        path: folder of the data set, new, empty or begun by an equal call.
        scene: the scene.
        train: number of training sequences.
        validation: number of validation sequences.
        test: number of test sequences.
        steps: control steps of each sequence.
        seed: seed, not negative.
        variants: number of random variants of the scene's system that the sequences of each split take in turn,
            no split another's; at least as many as sequences give each sequence its own. Default: all are of
            the scene itself. The paper does not say how many variants its 20000 sequences are of.
        knot_interval: control steps between the knots of the random actions.
        num_threads: threads of the simulation. Default: the cores this process may use.
        progress: called with sequences done and wanted, after every chunk.
        map_chunks: what does the work on the chunks, like the built-in ``map`` and in its order: ``imap`` of a pool of
            processes or of a :class:`~torchrl_gn.training.RayCluster`. The data are the same.

    Raises:
        ValueError: a size, ``steps`` or ``variants`` is below one, ``seed`` below zero or ``knot_interval`` not
            above 0 and finite, or the scene is of no system that has variants.
        DatasetError: the folder holds something else, another or a damaged data set; nothing of it
            is changed.
        UnstableSimulationError: more than a tenth of a chunk's simulations, and more than ten, become unstable.
    """
    sizes = dict(zip(SPLITS, map(index, (train, validation, test)), strict=True))
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    counts = {**sizes, "steps": steps, **({} if variants is None else {"variants": variants})}
    for name, value in counts.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    check_knot_interval(knot_interval)
    ranges = None
    if variants is not None:
        ranges = {name: [one.low, one.high] for name, one in parameter_ranges(_system(scene)).items()}
    files = DatasetFiles(Path(path))
    request = {
        "scene": scene.name,
        "fingerprint": scene.fingerprint(),
        "sizes": sizes,
        "steps": index(steps),
        "seed": index(seed),
        "knot_interval": float(knot_interval),
        "chunk": CHUNK,
        "variants": None if variants is None else index(variants),
        "parameters": ranges,
    }
    with files.lock():
        if files.exists():
            manifest = files.read()
            _check_same(files, manifest, request)
            files.verify(manifest)
        else:
            manifest = {
                "format": FORMAT,
                "request": request,
                "description": _description(scene),
                "entries": {
                    "state": [steps + 1, scene.num_nodes, 13],
                    "action": [steps, scene.num_actions],
                    "physics": [steps + 1, scene.physics_size],
                    **({} if ranges is None else _variant_entries(scene, len(ranges))),
                },
                "features": None if ranges is None else asdict(ParameterNames.of(scene)),
                "versions": simulation_versions(),
                "chunks": {split: [] for split in SPLITS},
            }
            files.create(manifest)
        if not files.is_complete(manifest):
            _collect_missing(files, manifest, scene, num_threads, progress, map_chunks)
    return _open(files, manifest, scene)


def load_dataset(path: str | os.PathLike, scene: Scene | None = None, *, verify: bool = True) -> TrajectoryDataset:
    """Open a finished data set.

    Args:
        path: folder of the data set.
        scene: the scene it must be of. Default: the one it was made with, built again.
        verify: compare every file with its checksums (reads all of it once).

    Raises:
        DatasetError: it is missing, unfinished, damaged, of another scene, of other physics of it or made by an older
            or newer version of this library. The message names the file and what to do.
    """
    files = DatasetFiles(Path(path))
    manifest = files.read()
    if not files.is_complete(manifest):
        done = {split: len(chunks) for split, chunks in manifest["chunks"].items()}
        raise DatasetError(
            f"{files.manifest_path}: the data set is unfinished (chunks done: {done}). Call create_dataset "
            "with the arguments it was begun with to finish it."
        )
    files.verify(manifest, checksums=verify)
    if scene is None:
        if manifest["description"] is None:
            raise DatasetError(
                f"{files.manifest_path}: scene {manifest['request']['scene']!r} was made from an MjSpec and "
                "cannot be built again from the data set. Pass it as load_dataset(path, scene)."
            )
        scene = scene_from_description(manifest["description"])
    elif scene.fingerprint() != manifest["request"]["fingerprint"]:
        raise DatasetError(
            f"{files.manifest_path}: the data set is of scene {manifest['request']['scene']!r} "
            f"(fingerprint {manifest['request']['fingerprint']}), not of {scene.name!r} "
            f"({scene.fingerprint()}). Load the data set of that scene, or create one in another folder."
        )
    return _open(files, manifest, scene)


def _collect_missing(
    files: DatasetFiles,
    manifest: dict,
    scene: Scene,
    num_threads: int | None,
    progress: Callable[[int, int], None] | None,
    map_chunks: Callable[[Callable, Iterable], Iterable],
) -> None:
    request, versions = manifest["request"], simulation_versions()
    if manifest["versions"] != versions:
        raise DatasetError(
            f"{files.manifest_path}: the data set was begun with {manifest['versions']} and would go on "
            f"differently with {versions}. Finish it with those versions, or use another folder."
        )
    total = sum(request["sizes"].values())
    done = sum(min(len(manifest["chunks"][split]) * CHUNK, size) for split, size in request["sizes"].items())
    chunks = list(_missing_chunks(manifest, scene))
    collector = _ChunkCollector(scene, request["steps"], request["seed"], request["knot_interval"], num_threads)
    stored, here = _stored_features(manifest), ParameterNames.of(scene)
    if stored and (missing := stored.missing_in(here)):
        raise DatasetError(
            f"{files.manifest_path}: the data set was begun with static features {missing}, which this version of"
            " torchrl_gn does not have. Finish it with that version, or use another folder."
        )
    for chunk, (data, rejected) in zip(chunks, map_chunks(collector, chunks), strict=True):
        if stored:
            _take_columns(data, stored.columns_in(here))
        arrays = {name: data.get(tuple(name.split("/"))).numpy() for name in manifest["entries"]}
        files.append(manifest, SPLITS[chunk.key[0]], arrays, rejected)
        done += chunk.count
        if progress is not None:
            progress(done, total)


@dataclass(frozen=True)
class _Chunk:
    """Sequences that are made together: seed key, number, and the parameters of each if they are of variants."""

    key: tuple[int, int]
    count: int
    parameters: np.ndarray | None


def _missing_chunks(manifest: dict, scene: Scene) -> Iterator[_Chunk]:
    request = manifest["request"]
    for number, (split, size) in enumerate(request["sizes"].items()):
        parameters = None
        if request["variants"] is not None:
            rng = np.random.default_rng(np.random.SeedSequence(request["seed"], spawn_key=(number,)))
            parameters = sample_parameters(_system(scene), min(request["variants"], size), rng)
        for first in range(len(manifest["chunks"][split]) * CHUNK, size, CHUNK):
            rows = np.arange(first, min(first + CHUNK, size))
            own = None if parameters is None else parameters[rows % len(parameters)]
            yield _Chunk((number, first // CHUNK), len(rows), own)


@dataclass
class _ChunkCollector:
    """Makes chunks, here or in another process."""

    scene: Scene
    steps: int
    seed: int
    knot_interval: float
    num_threads: int | None

    def __call__(self, chunk: _Chunk) -> tuple[TensorDict, int]:
        if chunk.parameters is None:
            simulator, variant = self.simulator, np.zeros(chunk.count, dtype=np.int64)
        else:
            # Built chunk by chunk: thousands of models at once would take gigabytes.
            distinct, variant = np.unique(chunk.parameters, axis=0, return_inverse=True)
            variant = variant.reshape(-1)  # some versions of NumPy keep the axis
            simulator = Simulator(_variants(self.scene, distinct), self.num_threads)
        data, rejected = collect_chunk(
            simulator, variant, self.steps, self.seed, chunk.key, knot_interval=self.knot_interval
        )
        if chunk.parameters is not None:
            data["parameters"] = variant_parameters(simulator.scenes, variant)
            data["variant_parameters"] = torch.from_numpy(chunk.parameters)
        return data, rejected

    @functools.cached_property
    def simulator(self) -> Simulator:
        return Simulator(self.scene, self.num_threads)

    def __getstate__(self) -> dict:
        """Without the simulator, whose threads stay in their process."""
        return {name: value for name, value in vars(self).items() if name != "simulator"}


def _system(scene: Scene) -> str:
    """Name of the system that variants of a scene are of.

    Raises:
        ValueError: if there is none, or the scene is itself a variant.
    """
    if "parameters" in scene.origin:
        raise ValueError(f"Scene {scene.name!r} is a variant already; give the standard system, without parameters.")
    if "system" not in scene.origin:
        raise ValueError(
            f"Scene {scene.name!r} is an MJCF model, which has no parameters to vary; give one of the paper's systems"
            " that torchrl_gn.scenes.parameter_ranges knows, or collect_trajectories a list of your own variants."
        )
    return scene.origin["system"]


def _variants(scene: Scene, parameters: np.ndarray) -> list[Scene]:
    return make_variants(_system(scene), parameters, timestep=scene.timestep, name=scene.name)


def _variant_entries(scene: Scene, parameters: int) -> dict[str, list[int]]:
    """Shapes of what sequences of variants have besides their states."""
    parameters = {f"static/{name}": list(value.shape) for name, value in PhysicalParameters.of(scene)._asdict().items()}
    return {**parameters, "variant_parameters": [parameters]}


def _open(files: DatasetFiles, manifest: dict, scene: Scene) -> TrajectoryDataset:
    rejected = {split: sum(chunk["rejected"] for chunk in chunks) for split, chunks in manifest["chunks"].items()}
    splits = {split: files.open(manifest, split) for split in SPLITS}
    features = _stored_features(manifest)
    if features:
        # In the order in which samples that are collected now have them.
        stored, features = features, ParameterNames.of(scene).common(features)
        for data in splits.values():
            _take_columns(data, features.columns_in(stored))
    return TrajectoryDataset(scene=scene, rejected=rejected, manifest=manifest, features=features, **splits)


def _stored_features(manifest: dict) -> ParameterNames | None:
    return None if manifest["features"] is None else ParameterNames.from_names(manifest["features"])


def _take_columns(data: TensorDict, columns: dict[str, list[int]]) -> None:
    """Keep some columns of the static features, in another order; what is right already stays mapped from disk."""
    for part, wanted in columns.items():
        values = data["parameters", part]
        if wanted != list(range(values.shape[-1])):
            data["parameters", part] = take_columns(values, wanted)


def _check_same(files: DatasetFiles, manifest: dict, request: dict) -> None:
    there = manifest["request"]
    differing = [key for key in request if there.get(key) != request[key]]
    if differing:
        what = ", ".join(f"{key} is {there.get(key)}, not {request[key]}" for key in differing)
        raise DatasetError(
            f"{files.manifest_path}: another data set is there ({what}). Use another folder, or delete this one."
        )


def _description(scene: Scene) -> dict | None:
    try:
        return scene.description()
    except SceneError:  # made from an MjSpec
        return None
