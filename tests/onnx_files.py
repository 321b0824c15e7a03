"""Tiny ONNX networks, written byte by byte: they take a picture and answer with tensors that are known beforehand.

An ONNX file is a protobuf message; these are the few fields of onnx.proto3 that a graph of constants needs.
"""

from pathlib import Path

import numpy as np

_TYPES = {np.dtype(np.float32): 1, np.dtype(np.uint8): 2, np.dtype(np.int64): 7}


def write_constant_network(
    path: Path, outputs: dict[str, np.ndarray], shape: tuple[int | str, ...] = (1, 3, "height", "width"), dtype: type = np.float32
) -> Path:
    """A network whose outputs are constants, whatever picture of `shape` it is shown."""
    graph = _text(2, "constants") + _message(11, _value("images", np.dtype(dtype), shape))
    for name, value in outputs.items():
        value = np.ascontiguousarray(value)
        tensor = b"".join(_number(1, n) for n in value.shape) + _number(2, _TYPES[value.dtype])
        graph += _message(5, tensor + _text(8, f"{name}_value") + _bytes(9, value.tobytes()))
        graph += _message(1, _text(1, f"{name}_value") + _text(2, name) + _text(4, "Identity"))
        graph += _message(12, _value(name, value.dtype, value.shape))
    path.write_bytes(_number(1, 8) + _message(7, graph) + _message(8, _number(2, 17)))
    return path


def _value(name: str, dtype: np.dtype, shape: tuple[int | str, ...]) -> bytes:
    dimensions = b"".join(_message(1, _number(1, n) if isinstance(n, int) else _text(2, n)) for n in shape)
    return _text(1, name) + _message(2, _message(1, _number(1, _TYPES[dtype]) + _message(2, dimensions)))


def _varint(n: int) -> bytes:
    out = bytearray()
    while n >= 128:
        out.append(n & 127 | 128)
        n >>= 7
    return bytes([*out, n])


def _number(field: int, n: int) -> bytes:
    return _varint(field << 3) + _varint(n)


def _bytes(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _text(field: int, text: str) -> bytes:
    return _bytes(field, text.encode())


def _message(field: int, content: bytes) -> bytes:
    return _bytes(field, content)
