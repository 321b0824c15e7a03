"""Where networks are trained and evaluated."""

import torch

from streetscan.errors import BadInput

NAMES = ("cpu", "cuda")


def choose_device(name: str) -> torch.device:
    """The device of a name, `cpu` or `cuda` (the first NVIDIA GPU). BadInput when it is another name, or there is no such GPU."""
    if name not in NAMES:
        raise BadInput("device", f"'{name}' is unknown", f"choose one of {', '.join(NAMES)}")
    if name == "cuda" and not torch.cuda.is_available():
        raise BadInput("device", "cuda, but PyTorch finds no NVIDIA GPU here", "use cpu, or install PyTorch for CUDA and the GPU's driver")
    return torch.device(name)
