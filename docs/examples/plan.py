"""Swing up a pendulum by planning with gradients through a trained model, and act in MuJoCo.

The picture shows the executed motion, one frame every 0.2 s.
"""

import sys

import numpy as np
import torch
from PIL import Image

import torchrl_gn as gn
from torchrl_gn.drawing import draw_states

picture = sys.argv[1] if sys.argv[1:] else "plan.png"
trained = gn.load_pretrained("pendulum")
scene = trained.scene()
reward = gn.make_reward("balance", scene)

true_env = gn.SceneEnv(scene, reward, seed=0)
model_env = gn.ModelEnv(gn.specialize(trained.bind(scene)), reward)
planner = gn.GradientPlanner(model_env, horizon=50, iterations=5, seed=0)
with torch.no_grad():
    executed = true_env.rollout(80, planner)

print(f"mean reward of the last second: {executed['next', 'reward'][-50:].mean():.3f}")
frames = draw_states(scene, executed["state"][::10], size=160)
Image.fromarray(np.concatenate(list(frames), axis=1)).save(picture)
