"""Measure the starts and random controls of a model: python docs/results/data/starts.py MODEL.xml [TIMESTEP]."""

import sys

import mujoco

from torchrl_gn.data import collect_trajectories, sample_start_states
from torchrl_gn.scenes import load_scene

scene = load_scene(sys.argv[1], timestep=float(sys.argv[2]) if len(sys.argv) > 2 else None)
model = scene.model
starts, data, deep = sample_start_states(scene, 500, 0), mujoco.MjData(model), 0
for start in starts:
    mujoco.mj_setState(model, data, start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_forward(model, data)
    deep += data.contact.dist.min(initial=0.0) < -1e-3
hinges = model.jnt_dofadr[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]
speed = collect_trajectories(scene, 50, steps=100, seed=0)["physics"][..., 1 + model.nq + hinges].abs().max()
print(f"{deep / len(starts):.0%} of the starts penetrate by more than 1 mm; fastest hinge {speed:.0f} rad/s")
