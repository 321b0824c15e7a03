"""Weights of a network (safetensors) and the settings that made them (YAML), and whether the two belong together."""

from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar

import torch
import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from streetscan.errors import BadInput
from streetscan.io.atomic import atomic_path

Settings = TypeVar("Settings")
_REMEDY = "give the settings.yaml that was written beside the weights"


def save_settings(settings: Any, path: str | Path) -> None:
    """Write a dataclass of plain values as YAML."""
    content = {name: _plain(value) for name, value in asdict(settings).items()}
    with atomic_path(path) as partial:
        partial.write_text(yaml.safe_dump(content, sort_keys=False))


def load_settings(cls: type[Settings], path: str | Path) -> Settings:
    """Read what `save_settings` wrote. BadInput when a key is missing, unknown or its value impossible."""
    try:
        content = yaml.safe_load(Path(path).read_text())
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        reason = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise BadInput(path, f"not readable as settings ({reason})", _REMEDY) from error
    names = {f.name for f in fields(cls)}
    if not isinstance(content, dict) or set(content) != names:
        odd = sorted(names.symmetric_difference(content if isinstance(content, dict) else ()))
        raise BadInput(path, f"keys missing or unknown: {', '.join(odd)}", _REMEDY)
    try:
        return cls(**content)
    except (TypeError, ValueError) as error:
        raise BadInput(path, f"a value of the wrong type ({error})", _REMEDY) from error


def save_weights(network: nn.Module, path: str | Path) -> None:
    """Write a network's weights as safetensors."""
    with atomic_path(path) as partial:
        save_file({name: tensor.detach().contiguous() for name, tensor in network.state_dict().items()}, partial)


def load_weights(network: nn.Module, path: str | Path, settings_path: str | Path) -> None:
    """Fill a network built from settings. BadInput when the file is damaged or was made with other settings."""
    try:
        tensors = load_file(path)
    except (OSError, SafetensorError) as error:
        raise BadInput(path, f"not a complete safetensors file ({error})", "train again or fetch the file again") from error
    fill_network(network, tensors, path, settings_path)


def fill_network(network: nn.Module, tensors: dict[str, torch.Tensor], path: str | Path, asked_by: object) -> None:
    """Give a network tensors of exactly its names and shapes.

    Args:
        network: to fill.
        tensors: by name.
        path: their file, named in errors.
        asked_by: what the network was built from, named in errors.
    Raises:
        BadInput: a name is missing, unknown or of another shape, or a weight is NaN or infinite.
    """
    expected = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    found = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    if found != expected:
        odd = sorted(name for name in expected | found if expected.get(name) != found.get(name))[0]
        detail = f"'{odd}' is {found.get(odd, 'missing')} where {asked_by} asks for {expected.get(odd, 'no such tensor')}"
        raise BadInput(path, f"weights made with other settings: {detail}", "give weights and settings of one training")
    if not all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values()):
        raise BadInput(path, "holds weights that are NaN or infinite", "train again")
    network.load_state_dict(tensors)


def check_equal_settings(found: Settings, wanted: Settings, where: object, ignored: tuple[str, ...] = ()) -> None:
    """Refuse weights that were made with other settings. BadInput names the first that differs."""
    for f in fields(found):
        if f.name not in ignored and getattr(found, f.name) != getattr(wanted, f.name):
            detail = f"{f.name} is {getattr(found, f.name)}, not {getattr(wanted, f.name)}"
            raise BadInput(
                where, f"weights made with other settings: {detail}", "give weights made with these settings or change the settings"
            )


def _plain(value: Any) -> Any:
    """Tuples as lists, however deep."""
    if isinstance(value, dict):
        return {name: _plain(inner) for name, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, (list, tuple)) else value
