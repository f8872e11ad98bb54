"""Dream in TorchRL's WorldModelEnv, with a trained graph network as the dynamics of TorchRL's WorldModel.

The picture shows how a policy that pumps energy into a pendulum rotates it, in truth and in dreams, from four starts.
"""

import sys

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import WorldModel

import torchrl_gn as gn
from torchrl_gn.envs import world_model_env
from torchrl_gn.evaluation import plot_motions

picture = sys.argv[1] if sys.argv[1:] else "world_model.png"
trained = gn.load_pretrained("pendulum")
scene = trained.scene()
reward = gn.make_reward("balance", scene)

world_model = WorldModel(
    encoder=TensorDictModule(nn.Identity(), in_keys=["state"], out_keys=["state"]),  # observations are states
    dynamics=gn.specialize(trained.bind(scene)),
    reward_head=TensorDictModule(reward, in_keys=["state", "action", ("next", "state")], out_keys=[("next", "reward")]),
)
true_env = gn.SceneEnv(scene, reward, seed=0)
dreams = world_model_env(world_model, true_env, 4)
pump = TensorDictModule(lambda state: torch.tanh(state[..., 1, 11:12]).float(), ["state"], ["action"])
start = true_env.reset(TensorDict(batch_size=[4]))
encoded = world_model.encode(start.select("state"))
with torch.no_grad():
    executed = true_env.rollout(150, pump, tensordict=start, auto_reset=False)
    dreamt = dreams.rollout(150, pump, tensordict=encoded, auto_reset=False)
error = (executed["next", "reward"] - dreamt["next", "reward"]).abs().max()
print(f"largest difference of rewards: {error:.1e}")
motions = {"true (pale) and dreamt (dashed)": (executed["state"], dreamt["state"])}
plot_motions(motions, scene, picture, labels=[f"start {number}" for number in range(1, 5)])
