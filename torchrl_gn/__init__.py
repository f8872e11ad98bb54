"""Graph networks as learnable physics engines, for TorchRL."""

__version__ = "0.1.0"
