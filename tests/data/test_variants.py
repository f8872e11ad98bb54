"""Trajectories of random variants, in memory and on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchrl_gn.data import (
    DatasetError,
    Simulator,
    collect_trajectories,
    create_dataset,
    load_dataset,
    sample_start_states,
    spline_controls,
    trajectory_buffer,
)
from torchrl_gn.scenes import PhysicalParameters, Scene, load_scene, make_variants, parameter_ranges, sample_variants

from .. import zoo
from .conftest import contents, equal

SYSTEMS = ["pendulum", "cartpole", "swimmer3", "swimmer6", "cheetah", "jaco"]
SIZES: dict[str, Any] = {"train": 10, "validation": 5, "test": 4, "steps": 6, "seed": 3}
SPLITS = ("train", "validation", "test")


@pytest.mark.parametrize("system", SYSTEMS)
def test_together_as_each_alone(system: str) -> None:
    scenes = sample_variants(system, 5, 0)
    data = collect_trajectories(scenes, 7, 20, seed=1)
    assert equal(data, collect_trajectories(scenes, 7, 20, seed=1, simulator=Simulator(scenes, 2)))
    for i in range(7):
        scene = scenes[i % 5]
        alone = Simulator(scene, 1).rollout(data["physics"][i, 0], data["action"][i])
        assert alone["stable"] and torch.equal(alone["state"], data["state"][i])
        assert torch.equal(alone["physics"], data["physics"][i])
        for name, value in PhysicalParameters.of(scene)._asdict().items():
            assert torch.equal(data["parameters", name][i], value)


@pytest.mark.parametrize("system", SYSTEMS)
def test_joined_bodies_stay_joined(system: str) -> None:
    scenes = sample_variants(system, 5, 2)
    state = collect_trajectories(scenes, 5, 20)["state"]
    for scene, states in zip(scenes, state.numpy(), strict=True):
        positions = []
        for node, anchors in (
            (scene.joint_anchors.parent, scene.joint_anchors.parent_anchor),
            (np.arange(scene.num_nodes), scene.joint_anchors.child_anchor),
        ):
            w, v = states[:, node, 3:4], states[:, node, 4:7]
            turned = np.cross(v, np.cross(v, anchors) + w * anchors)
            positions.append(states[:, node, :3] + anchors + 2 * turned)
        assert np.abs(positions[1] - positions[0]).max() < 1e-12
        assert np.ptp(states[:, 1:, :7], axis=0).max() > 1e-3  # and something moves


@pytest.mark.slow
def test_starts_are_of_the_variants_own_model() -> None:
    scenes = sample_variants("cheetah", 30, 0)
    data = collect_trajectories(scenes, 30, 1)
    for scene, start in zip(scenes, data["physics"][:, 0].numpy(), strict=True):
        points, state = scene.contact_points, Simulator(scene, 1).observe(torch.from_numpy(start)).numpy()
        assert points is not None
        w, v = state[points.node, 3:4], state[points.node, 4:7]
        place = state[points.node, :3] + points.offset
        place += 2 * np.cross(v, np.cross(v, points.offset) + w * points.offset)
        height = (place[:, 2] - points.radius).min()
        assert -0.1 < height < 0.05, scene.origin  # settled on the ground, however long the legs


@pytest.mark.slow
def test_variants_are_stable() -> None:
    for system in SYSTEMS:
        scenes = sample_variants(system, 12 if system == "jaco" else 60, 5)  # an arm takes its time
        rng = np.random.default_rng(0)
        starts = np.concatenate([sample_start_states(scene, 1, rng) for scene in scenes])
        executed = Simulator(scenes).rollout(starts, spline_controls(scenes[0], len(scenes), 30, rng))
        assert executed["stable"].all(), system


@pytest.mark.slow
@pytest.mark.usefixtures("small_chunks")
@pytest.mark.parametrize("count", [1, 3, 100])
def test_on_disk_as_in_memory(tmp_path: Path, count: int) -> None:
    scene = load_scene("cartpole", timestep=0.02)
    made = create_dataset(tmp_path / "d", scene, **SIZES, variants=count)
    loaded = load_dataset(tmp_path / "d")
    assert loaded.scene.fingerprint() == scene.fingerprint()
    seen = []
    for number, split in enumerate(SPLITS):
        data = getattr(loaded, split)
        assert equal(getattr(made, split), data)
        own = min(count, SIZES[split])
        parameters = data["variant_parameters"].numpy()
        assert len(np.unique(parameters, axis=0)) == own
        assert np.array_equal(parameters, parameters[np.arange(len(data)) % own])
        seen.append(parameters[:own])
        scenes = make_variants("cartpole", parameters[:own], timestep=0.02)
        expected = collect_trajectories(scenes, SIZES[split], 6, seed=3, split=number)
        assert equal(data.exclude("variant_parameters"), expected)
        last = loaded.scene_of(split, len(data) - 1)
        assert last.fingerprint() == scenes[(len(data) - 1) % own].fingerprint()
    everything = np.concatenate(seen)
    assert len(np.unique(everything, axis=0)) == len(everything)  # no variant is in two splits
    assert list(loaded.manifest["request"]["parameters"]) == list(parameter_ranges("cartpole"))
    with pytest.raises(ValueError, match="split='tset' is not known"):
        loaded.scene_of("tset", 0)


@pytest.mark.slow
@pytest.mark.usefixtures("small_chunks")
@pytest.mark.parametrize("after", [2, 4])
def test_interrupted_resumes_to_identical_data(tmp_path: Path, after: int) -> None:
    scene, calls = load_scene("pendulum"), []

    def interrupt(*_) -> None:
        calls.append(None)
        if len(calls) == after:
            raise KeyboardInterrupt

    create_dataset(tmp_path / "whole", scene, **SIZES, variants=6)
    with pytest.raises(KeyboardInterrupt):
        create_dataset(tmp_path / "parts", scene, **SIZES, variants=6, progress=interrupt)
    create_dataset(tmp_path / "parts", scene, **SIZES, variants=6)
    assert contents(tmp_path / "whole") == contents(tmp_path / "parts")


def test_damaged_and_other_data_are_refused(tmp_path: Path) -> None:
    scene = load_scene("pendulum")
    create_dataset(tmp_path / "d", scene, **SIZES, variants=6)
    for other in (None, 7):
        with pytest.raises(DatasetError, match=f"variants is 6, not {other}"):
            create_dataset(tmp_path / "d", scene, **SIZES, variants=other)
    file = tmp_path / "d" / "validation" / "parameters" / "nodes.memmap"
    content = bytearray(file.read_bytes())
    content[50] ^= 1
    file.write_bytes(content)
    with pytest.raises(DatasetError, match="nodes.memmap.*have other checksums"):
        load_dataset(tmp_path / "d")


def test_scenes_without_variants_are_refused(tmp_path: Path, swimmer: Scene) -> None:
    for scene, message in (
        (load_scene("acrobot"), "'acrobot' has no parameters to vary"),
        (zoo.load("pole", name="swimmer6"), "'swimmer6' is an MJCF model"),
        (load_scene("pendulum", parameters={"mass": 2}), "'pendulum' is a variant already"),
    ):
        with pytest.raises(ValueError, match=message):
            create_dataset(tmp_path / "d", scene, **SIZES, variants=3)
    with pytest.raises(ValueError, match="variants=0 must be a whole number"):
        create_dataset(tmp_path / "d", swimmer, **SIZES, variants=0)
    assert not (tmp_path / "d").exists()


def test_samples_bring_their_trajectorys_values(tmp_path: Path) -> None:
    data = create_dataset(tmp_path / "d", load_scene("pendulum"), **SIZES, variants=10).train
    for window in (1, 3):
        batch = trajectory_buffer(data, batch_size=40, window=window, seed=0).sample()
        trajectory = batch["index"][..., 0]
        for name in PhysicalParameters._fields:
            assert torch.equal(batch["parameters", name], data["parameters", name][trajectory])
