"""TorchRL loss modules."""

from torchrl_gn.objectives.forward_model_loss import ForwardModelLoss as ForwardModelLoss
from torchrl_gn.objectives.identification_loss import IdentificationLoss as IdentificationLoss
from torchrl_gn.objectives.observation_model_loss import ObservationModelLoss as ObservationModelLoss
from torchrl_gn.objectives.several_scenes_loss import SeveralScenesLoss as SeveralScenesLoss
from torchrl_gn.objectives.shac_loss import SHACLoss as SHACLoss
from torchrl_gn.objectives.svg_loss import SVGLoss as SVGLoss
