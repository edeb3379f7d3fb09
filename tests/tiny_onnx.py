"""Tiny ONNX networks written as raw protobuf, so that tests need neither the onnx package nor a file from elsewhere."""

from collections.abc import Sequence
from pathlib import Path

FLOAT, FLOAT16, UINT8 = 1, 10, 2  # TensorProto.DataType
INT, INTS = 2, 7  # AttributeProto.AttributeType
EXTERNAL = 1  # TensorProto.DataLocation


def mean_network(
    path: Path,
    height: int | str,
    width: int | str,
    channels: int = 3,
    dtype: int = FLOAT,
    outputs: int = 1,
    batch: int = 1,
    named: str = "disparity",
) -> Path:
    """A network whose output [N, outputs, H, W] is the mean of its input channels; a size given as text is dynamic."""
    steps = [_node("ReduceMean", ["image"], ["mean"], axes=[1], keepdims=1)]
    if outputs == 1:
        steps.append(_node("Identity", ["mean"], [named]))
    else:
        steps.append(_node("Concat", ["mean"] * outputs, [named], axis=1))
    graph = b"".join(_message(1, step) for step in steps) + _text(2, "mean")
    graph += _message(11, _value("image", dtype, [batch, channels, height, width]))
    graph += _message(12, _value(named, dtype, [batch, outputs, height, width]))
    opset = _text(1, "") + _varint(2, 13)
    path.write_bytes(_varint(1, 8) + _message(7, graph) + _message(8, opset))
    return path


def flow_network(path: Path, height: int | str, width: int | str, dtype: int = FLOAT, whole: bool = True) -> Path:
    """A network of two images that returns the means of both, and, if `whole`, of their channels at each pixel."""
    images = ("first", "second")
    steps = [_node("ReduceMean", [name], [f"mean {name}"], axes=[1], keepdims=1) for name in images]
    steps.append(_node("Concat", [f"mean {name}" for name in images], ["flow"], axis=1))
    steps.append(_node("GlobalAveragePool", ["flow"], ["coarse"]))
    graph = b"".join(_message(1, step) for step in steps) + _text(2, "flow")
    graph += b"".join(_message(11, _value(name, dtype, [1, 3, height, width])) for name in images)
    graph += _message(12, _value("coarse", dtype, [1, 2, 1, 1]))
    graph += _message(12, _value("flow", dtype, [1, 2, height, width])) if whole else b""
    path.write_bytes(_varint(1, 8) + _message(7, graph) + _message(8, _text(1, "") + _varint(2, 13)))
    return path


def scaled_network(path: Path, weights: str) -> Path:
    """A network whose output [1, 3, 6, 8] is the image times a number that lies in the file `weights` beside it."""
    entry = b"".join(
        _message(13, _text(1, key) + _text(2, value)) for key, value in (("location", weights), ("length", "4"))
    )
    tensor = _varint(1, 1) + _varint(2, FLOAT) + _text(8, "factor") + entry + _varint(14, EXTERNAL)
    product = _node("Mul", ["image", "factor"], ["scaled"])
    mean = _node("ReduceMean", ["scaled"], ["disparity"], axes=[1], keepdims=1)
    graph = _message(1, product) + _message(1, mean) + _text(2, "scaled") + _message(5, tensor)
    graph += _message(11, _value("image", FLOAT, [1, 3, 6, 8]))
    graph += _message(12, _value("disparity", FLOAT, [1, 1, 6, 8]))
    opset = _text(1, "") + _varint(2, 13)
    path.write_bytes(_varint(1, 8) + _message(7, graph) + _message(8, opset))
    return path


def _node(operation: str, inputs: Sequence[str], outputs: Sequence[str], **attributes: int | list[int]) -> bytes:
    parts = [_text(1, name) for name in inputs] + [_text(2, name) for name in outputs] + [_text(4, operation)]
    for name, value in attributes.items():
        if isinstance(value, list):
            body = _text(1, name) + b"".join(_varint(8, item) for item in value) + _varint(20, INTS)
        else:
            body = _text(1, name) + _varint(3, value) + _varint(20, INT)
        parts.append(_message(5, body))
    return b"".join(parts)


def _value(name: str, dtype: int, shape: Sequence[int | str]) -> bytes:
    dims = (_varint(1, size) if isinstance(size, int) else _text(2, size) for size in shape)
    tensor = _varint(1, dtype) + _message(2, b"".join(_message(1, dim) for dim in dims))
    return _text(1, name) + _message(2, _message(1, tensor))


def _varint(field: int, value: int) -> bytes:
    return _base128(field << 3) + _base128(value)


def _text(field: int, value: str) -> bytes:
    return _message(field, value.encode())


def _message(field: int, body: bytes) -> bytes:
    return _base128(field << 3 | 2) + _base128(len(body)) + body


def _base128(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])
