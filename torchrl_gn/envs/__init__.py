"""Scenes as TorchRL environments: the true physics and the learned model, with the same specs."""

from torchrl_gn.envs.batched import batched as batched
from torchrl_gn.envs.model_env import ModelEnv as ModelEnv
from torchrl_gn.envs.scene_env import SceneEnv as SceneEnv
