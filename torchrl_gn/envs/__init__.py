"""TorchRL environments of scenes: true physics and learned model, with the same specs."""

from torchrl_gn.envs.model_env import ModelEnv as ModelEnv
from torchrl_gn.envs.scene_env import SceneEnv as SceneEnv
from torchrl_gn.envs.starts import batched as batched
from torchrl_gn.envs.suite_env import observation_env as observation_env
from torchrl_gn.envs.suite_env import suite_env as suite_env
from torchrl_gn.envs.suite_task_env import SuiteTaskEnv as SuiteTaskEnv
from torchrl_gn.envs.world_model_env import world_model_env as world_model_env
