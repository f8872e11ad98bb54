"""System identification: the inference model."""

from torchrl_gn.identification.inference_model import BoundInferenceModel as BoundInferenceModel
from torchrl_gn.identification.inference_model import IdentifyingModel as IdentifyingModel
from torchrl_gn.identification.inference_model import InferenceModel as InferenceModel
