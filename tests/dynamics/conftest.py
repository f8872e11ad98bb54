"""Models of the native executor's tests."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torchrl_gn.dynamics import BoundPredictor, ForwardModel, Predictor, SpecializedPredictor, specialize
from torchrl_gn.dynamics.bound import reference_state


@pytest.fixture(scope="session")
def wide(scenes, fit) -> Callable[..., BoundPredictor]:
    """Bound predictor of a system, its network wide enough for whole vectors and rests of them."""

    def make(name: str = "swimmer6", dtype=torch.float32, **options) -> BoundPredictor:
        options = {"latent": 20, "edge_hidden": (36,), "node_hidden": (36,), "activation": "silu"} | options
        torch.manual_seed(0)
        model = fit(ForwardModel.for_scene(scenes[name], **options), scenes[name])
        return model.to(dtype).requires_grad_(False).bind(scenes[name])

    return make


@pytest.fixture(scope="session")
def quick(wide) -> Callable[..., SpecializedPredictor]:
    """The same, specialised: a value, made once for all tests, which must not change it."""
    made: dict[str, SpecializedPredictor] = {}

    def make(name: str = "swimmer6", dtype=torch.float32, products=None, executor="native", **options):
        key = repr((name, dtype, products, executor, sorted(options.items())))
        if key not in made:
            made[key] = specialize(wide(name, dtype, **options), dtype=products, executor=executor)
        return made[key]

    return make


@pytest.fixture(scope="session")
def moved() -> Callable[..., Tensor]:
    """States ``[*batch, N, 13]`` that differ from a predictor's reference pose in what can move alone."""

    def draw(predictor: Predictor, *batch: int, seed: int = 3, scale: float = 0.3) -> Tensor:
        scene, layout = predictor.scene, predictor.layout
        generator = torch.Generator().manual_seed(seed)
        shape = (*batch, scene.num_nodes, layout.delta_size)
        change = scale * torch.randn(shape, generator=generator, dtype=torch.float64) * torch.as_tensor(scene.movable)
        return layout.apply(reference_state(scene, layout).expand(*batch, -1, -1), change)

    return draw


@pytest.fixture(scope="session")
def inputs(moved, random_actions) -> Callable[..., tuple[Tensor, Tensor]]:
    """Make states of moved scenes, and actions ``[*batch, steps, A]``."""

    def draw(predictor: Predictor, *batch: int, steps: int = 3, seed: int = 3) -> tuple[Tensor, Tensor]:
        return moved(predictor, *batch, seed=seed), random_actions(predictor.scene, *batch, steps, seed=seed)

    return draw
