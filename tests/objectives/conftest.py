"""Scenes, simulated transitions and losses that the loss tests share."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import Scene

from .. import zoo
from ..sizes import SMALL


@pytest.fixture(scope="session")
def scenes() -> dict[str, Scene]:
    return {name: zoo.load(name) for name in ("pendulum", "swimmer6", "falling")}


def _windows(trajectories: TensorDict) -> TensorDict:
    """``[M, T]`` windows of whole trajectories."""
    state, action = trajectories["state"], trajectories["action"]
    return TensorDict(
        {"state": state[:, :-1], "action": action, "next": {"state": state[:, 1:]}},
        batch_size=action.shape[:2],
    )


@pytest.fixture(scope="session")
def windows(scenes) -> dict[str, TensorDict]:
    """``[40, 6]`` simulated windows of every scene; ``falling`` has random made-up motion."""
    simulated = {
        name: _windows(collect_trajectories(scenes[name], num=40, steps=6)) for name in ("pendulum", "swimmer6")
    }
    generator = torch.Generator().manual_seed(0)
    change = 0.1 * torch.randn(40, 6, 2, 12, generator=generator, dtype=torch.float64)
    change[..., 0, :] = 0
    from torchrl_gn.maths import BODY_STATE

    start = torch.zeros(40, 2, 13, dtype=torch.float64)
    start[..., 3] = 1
    states = [start]
    for step in change.unbind(1):
        states.append(BODY_STATE.apply(states[-1], step))
    made_up = TensorDict({"state": torch.stack(states, 1), "action": torch.zeros(40, 6, 0)}, [40])
    return simulated | {"falling": _windows(made_up)}


@pytest.fixture
def make_loss(scenes, windows) -> Callable[..., ForwardModelLoss]:
    """A loss of a small float64 model whose normalisers are fitted."""

    def make(name: str = "swimmer6", *, fitted: bool = True, model: dict | None = None, **options) -> ForwardModelLoss:
        torch.manual_seed(0)
        network = ForwardModel.for_scene(scenes[name], **(SMALL | (model or {}))).double()
        loss = ForwardModelLoss(network.bind(scenes[name]), **options)
        if fitted:
            loss.fit_normalizers(windows[name].reshape(-1))
        return loss

    return make
