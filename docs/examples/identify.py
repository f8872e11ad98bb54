"""Identify pendulums of unknown length and mass from 20 observed steps, and predict the next two seconds.

The picture shows true and predicted rotation, with the identified graph of each system and with that of another.
"""

import sys

import torch

import torchrl_gn as gn
from torchrl_gn.evaluation import plot_motions
from torchrl_gn.scenes import sample_variants

picture = sys.argv[1] if sys.argv[1:] else "identify.png"
trained = gn.load_pretrained("identified_pendulum")
scene = trained.scene()
predictor, inference = trained.trained.bind(scene)

systems = sample_variants("pendulum", 3, rng=1)
data = gn.collect_trajectories(systems, 3, steps=120, seed=1)
state, action = data["state"], data["action"]
with torch.no_grad():
    graphs = inference.identify(state[:, :21], action[:, :20])
    own, _ = predictor.rollout(state[:, 20], action[:, 20:], graphs)
    other, _ = predictor.rollout(state[:, 20], action[:, 20:], graphs.roll(1, 0))

panels = {"its own graph": (state, own), "another's graph": (state, other)}
plot_motions(panels, scene, picture, labels=["system 1", "system 2", "system 3"])
