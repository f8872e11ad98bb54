"""TorchRL loss modules."""

from torchrl_gn.objectives.forward_model_loss import ForwardModelLoss as ForwardModelLoss
