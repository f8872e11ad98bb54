"""Export a trained model as a program that needs PyTorch alone, and as C++ source that needs nothing.

The picture shows two seconds predicted by the exported program, and the true motion.
"""

import sys

import torch

import torchrl_gn as gn
from torchrl_gn.evaluation import plot_body_trajectory

picture = sys.argv[1] if sys.argv[1:] else "export.png"
trained = gn.load_pretrained("swimmer6")
scene = trained.scene()
model = trained.bind(scene)

gn.export_step(model, "swimmer6.pt2")
for file in sorted(gn.export_c(model, "swimmer6").iterdir()):
    print(f"{file.name}: {file.stat().st_size / 1e3:,.0f} kB")

true = gn.collect_trajectories(scene, 1, steps=100, seed=1)
step = torch.export.load("swimmer6.pt2").module()
states = [true["state"][:, 0]]
with torch.no_grad():
    for action in true["action"].float().unbind(1):
        states.append(step(states[-1], action))
plot_body_trajectory(true["state"][0], torch.cat(states), scene, picture)
