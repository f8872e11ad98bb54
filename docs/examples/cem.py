"""Plan with TorchRL's cross-entropy method through a trained model, and act in MuJoCo.

The picture shows the rewards of planned and of random actions, from the same start.
"""

import sys

import torch
from torchrl.modules import CEMPlanner

import torchrl_gn as gn
from torchrl_gn.evaluation import plot_rewards

picture = sys.argv[1] if sys.argv[1:] else "cem.png"
torch.manual_seed(0)
trained = gn.load_pretrained("cartpole")
scene = trained.scene()
reward = gn.make_reward("balance", scene)

true_env = gn.SceneEnv(scene, reward, seed=0)
model_env = gn.ModelEnv(gn.specialize(trained.bind(scene)), reward)
planner = CEMPlanner(model_env, planning_horizon=25, optim_steps=2, num_candidates=64, top_k=8)

start = true_env.reset()
rewards = {}
with torch.no_grad():
    for name, policy in {"CEM": planner, "random": None}.items():
        executed = true_env.rollout(100, policy, tensordict=start.clone(), auto_reset=False)
        rewards[name] = executed["next", "reward"].T
        print(f"{name}: mean reward {rewards[name].mean():.3f}")
plot_rewards(rewards, picture, timestep=scene.timestep)
