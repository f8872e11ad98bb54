"""Train a policy by the gradient of its return through a trained model of a cart-pole.

The picture shows rewards of the policy and of random actions on the true physics: mean, best and worst of 20 episodes.
"""

import sys

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

import torchrl_gn as gn
from torchrl_gn.evaluation import plot_rewards

torch.manual_seed(0)
trained = gn.load_pretrained("cartpole")
scene = trained.scene()
reward = gn.make_reward("balance", scene)
model_env = gn.ModelEnv(gn.specialize(trained.bind(scene)), reward, seed=0)
true_env = gn.SceneEnv(scene, reward, seed=1)

layers = nn.Linear(39, 64), nn.ELU(), nn.Linear(64, 64), nn.ELU(), nn.Linear(64, 1), nn.Tanh()
network = nn.Sequential(nn.Flatten(-2), *layers).double()  # 3 nodes with 13 numbers each
policy = TensorDictModule(network, in_keys=["state"], out_keys=["action"])
optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
for _ in range(100):
    start = model_env.reset(TensorDict(batch_size=[32]))
    imagined = model_env.rollout(50, policy, tensordict=start, auto_reset=False)
    (-imagined["next", "reward"].mean()).backward()
    optimizer.step()
    optimizer.zero_grad()

start = true_env.reset(TensorDict(batch_size=[20]))
rewards = {}
for name, actor in {"policy": policy.requires_grad_(False), "random": None}.items():
    executed = true_env.rollout(200, actor, tensordict=start.clone(), auto_reset=False)
    rewards[name] = executed["next", "reward"][..., 0]
plot_rewards(rewards, sys.argv[1] if sys.argv[1:] else "policy.png", timestep=scene.timestep)
