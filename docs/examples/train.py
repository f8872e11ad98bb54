"""Train a forward model of a three-link swimmer on trajectories under random controls.

The picture shows the loss over training time.
"""

import sys

import torchrl_gn as gn
from torchrl_gn.evaluation import plot_training_curve

picture = sys.argv[1] if sys.argv[1:] else "train.png"
scene = gn.load_scene("swimmer3")
train = gn.collect_trajectories(scene, 200, seed=0)
test = gn.collect_trajectories(scene, 20, seed=1)

model = gn.ForwardModel.for_scene(scene).bind(scene)
history = gn.fit(model, train, steps=300, progress=False)

print(history)
print(gn.evaluate_errors(model, test, horizons=(20, 100)))
plot_training_curve({"training": (history.seconds, history.losses)}, picture, ylabel="loss")
