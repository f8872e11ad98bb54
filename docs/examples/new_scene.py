"""Load a robot of your own from MJCF text, and train a forward model of it.

The picture shows a body's true motion and its prediction from the first state and the controls alone.
"""

import sys

import torch

import torchrl_gn as gn
from torchrl_gn.evaluation import plot_body_trajectory

picture = sys.argv[1] if sys.argv[1:] else "new_scene.png"
scene = gn.load_scene("""
<mujoco model="two_link">
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03"/>
      <body name="lower" pos="0 0 -.4">
        <joint name="elbow" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".025"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="elbow" joint="elbow" ctrlrange="-2 2"/></actuator>
</mujoco>
""")
print(scene)

model = gn.ForwardModel.for_scene(scene, hidden=64).bind(scene)
print(gn.fit(model, gn.collect_trajectories(scene, 400, seed=0), steps=400, progress=False))

true = gn.collect_trajectories(scene, 1, steps=50, seed=1)[0]
with torch.no_grad():
    predicted, _ = model.rollout(true["state"][:1], true["action"][None])
plot_body_trajectory(true["state"], predicted[0], scene, picture, node="lower")
