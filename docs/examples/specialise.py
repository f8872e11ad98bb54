"""Specialise a trained model for its scene, which leaves out what the scene does not need and runs the rest in C++.

The picture shows the time of a 20-step rollout, before and after, over the number of rollouts in a batch.
"""

import sys
from timeit import repeat

import torch

import torchrl_gn as gn
from torchrl_gn.evaluation import plot_loglog

picture = sys.argv[1] if sys.argv[1:] else "specialise.png"
trained = gn.load_pretrained("swimmer6")
scene = trained.scene()
model = trained.bind(scene)
fast = gn.specialize(model)
print(fast)

batches = [1, 4, 16, 64]
starts = gn.collect_trajectories(scene, max(batches), steps=20, seed=0)
lines = {}
for name, predictor in {"model": model, "specialised model": fast}.items():
    milliseconds = []
    for batch in batches:
        state, action = starts["state"][:batch, 0], starts["action"][:batch]
        with torch.no_grad():
            predictor.rollout(state, action)  # warm up
            times = repeat(lambda: predictor.rollout(state, action), number=1, repeat=3)  # noqa: B023
        milliseconds.append(1e3 * min(times))
    lines[name] = batches, milliseconds
plot_loglog({"rollouts in a batch": lines}, picture, ylabel="20-step rollout [ms]")
