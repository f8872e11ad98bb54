"""Adapter that gives any TensorDict module that predicts a next state the methods of a predictor."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_gn.dynamics.adaptation import AdaptedPredictor
from torchrl_gn.dynamics.ensemble import BoundEnsemble, SplitEnsemble, mean_of
from torchrl_gn.dynamics.predictor import Predictor


def as_predictor(module: TensorDictModuleBase) -> Predictor | ModulePredictor:
    """Return the module itself if it is a :class:`Predictor`, else a :class:`ModulePredictor` around it.

    A module without the keys ``state`` and ``action`` reads them at its first two ``in_keys``. One without
    ``("next", "state")`` writes the next state at the first of its ``out_keys``.
    """
    return module if isinstance(module, Predictor) else ModulePredictor(module)


class ModulePredictor:
    """Methods of a :class:`Predictor` for another TensorDict module.

    Inputs other than state and action are the hidden state. They are carried from step to step and updated by the
    entries that the module writes at ``next``.
    """

    fixed_batch = recurrent = False
    check_every = 1  # steps between checks of a guarded rollout; a module may refuse states that are not finite

    def __init__(self, module: TensorDictModuleBase) -> None:
        self.module = module
        named = {"state", "action"} <= set(module.in_keys)
        self.keys = ["state", "action"] if named else list(module.in_keys[:2])
        self.rest = [key for key in module.in_keys if key not in self.keys]
        self.out_key = ("next", "state") if ("next", "state") in module.out_keys else module.out_keys[0]
        if hasattr(module, "fixed_batch"):
            self.fixed_batch = module.fixed_batch

    def parameters_in(self, tensordict: TensorDictBase) -> None:
        """Return None, as only predictors read physical parameters; ValueError if a predictor within refuses them."""
        if hasattr(self.module, "parameters_in"):
            cast(Any, self.module).parameters_in(tensordict)

    def hidden_state_in(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.select(*self.rest, strict=False)

    def in_range(self, states: Tensor, limit: float) -> Tensor:
        """Return ``[*B]`` bool, True where states ``[*B, N, C]`` are finite; ``limit`` is not used."""
        return states.isfinite().flatten(-2).all(-1)

    def step(
        self, state: Tensor, action: Tensor, parameters: None = None, hidden_state: TensorDictBase | None = None
    ) -> tuple[Tensor, TensorDictBase]:
        if isinstance(self.module, BoundEnsemble):  # its mean needs no calibration
            return mean_of(self.module.step(state, action), self.module.layout), hidden_state  # pyright: ignore[reportReturnType]
        batch = state.shape[:-2]
        entries = TensorDict(batch_size=batch) if hidden_state is None else hidden_state.copy()
        for key, value in zip(self.keys, (state, action), strict=True):
            entries.set(key, value)  # a key may be nested: set() splits it
        entries = self.module(entries)
        after = cast(Tensor, entries.get(self.out_key))
        next_hidden = TensorDict(batch_size=batch) if hidden_state is None else hidden_state.copy()
        if "next" in entries.keys():
            next_hidden.update(cast(TensorDictBase, entries["next"]).select(*self.rest, strict=False))
        return after, next_hidden

    def rollout(
        self, state: Tensor, actions: Tensor, parameters: None = None, hidden_state: TensorDictBase | None = None
    ) -> tuple[Tensor, TensorDictBase | None]:
        if isinstance(self.module, (AdaptedPredictor, SplitEnsemble)):
            return self.module.rollout(state, actions), None
        states = [state]
        for action in actions.unbind(-2):
            state, hidden_state = self.step(state, action, None, hidden_state)
            states.append(state)
        return torch.stack(states, dim=-3), hidden_state

    def teacher_forced(
        self, states: Tensor, actions: Tensor, parameters: None = None
    ) -> tuple[Tensor, TensorDictBase | None]:
        batch = actions.shape[:-1]
        after, _ = self.step(states.flatten(0, -3), actions.flatten(0, -2))
        return after.unflatten(0, batch), None
