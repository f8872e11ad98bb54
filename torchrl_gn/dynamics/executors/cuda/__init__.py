"""Executor for NVIDIA GPUs: state maths as CUDA kernels, the network by torch, steps as CUDA graphs."""

from torchrl_gn.dynamics.executors.cuda.executor import CudaExecutor as CudaExecutor
