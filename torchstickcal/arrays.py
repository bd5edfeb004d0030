"""Arrays and numbers from outside: the one place where they become tensors and plain numbers, or are refused."""

from __future__ import annotations

import math
import numbers
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.masked import MaskedTensor

from torchstickcal.errors import CalibrationError, ObservationError, quoted
from torchstickcal.precision import at_least_float32

FARTHEST_PX = 1e7
"""What lies farther than this from the corner of an image, in pixels, is no keypoint: no image is as large."""

_INTEGERS = {torch.uint8, torch.uint16, torch.uint32, torch.uint64, torch.int8, torch.int16, torch.int32, torch.int64}
_LARGEST_INDEX = 2**31
_KINDS = {
    "b": "truth values",
    "c": "complex numbers",
    "m": "time differences",
    "M": "dates",
    "O": "Python objects",
    "S": "bytes",
    "U": "text",
    "V": "records",
}


def tensor_of(
    value: Any,
    where: str,
    *,
    device: torch.device | None = None,
    masked: float | None = None,
    keep_graph: bool = False,
) -> Tensor:
    """An array of real numbers as a tensor.

    Accepted are tensors, numpy arrays of any memory layout, byte order and precision, numbers, nested lists of all these, and
    objects of other libraries that numpy can read. The tensor is float32 or float64: these two are kept, float16 and bfloat16
    become float32, and integers and numbers longer than float64 become float64.

    Args:
        value: the array.
        where: the argument's name, for the error.
        device: of the tensor; None for that of the value.
        masked: what stands for the masked values of a numpy masked array; None where no value may be missing.
        keep_graph: whether gradients may flow back to the value.

    Raises:
        ObservationError: if it is no such array.

    Example:
        >>> import numpy as np
        >>> tensor_of(np.ma.masked_equal([[1, 2], [-1, 4]], -1), "keypoints", masked=torch.nan)
        tensor([[1., 2.],
                [nan, 4.]], dtype=torch.float64)
    """
    try:
        tensor = _tensor(value, where, masked)
    except RecursionError as error:
        raise _refused(where, "a list that is nested too deeply, or holds itself") from error
    tensor = (tensor if keep_graph else tensor.detach()).to(device)
    if not tensor.is_inference():
        return tensor
    with torch.inference_mode(mode=False):  # a tensor made in inference mode can take no part in gradients
        return tensor.clone()


def number_of(
    value: Any,
    where: str,
    *,
    what: str,
    expected: str,
    least: float,
    most: float,
    several: str = "",
    error: type[CalibrationError] = ObservationError,
) -> float:
    """One number, from ``least`` to ``most``: of Python or numpy, or an array or tensor without dimensions.

    Args:
        value: the number.
        where: the argument's name, for the error.
        what: the problem, if it is no such number.
        expected: what would be accepted.
        least: the smallest number that can be used.
        most: the largest one.
        several: the remedy where several numbers are given.
        error: the kind of error.

    Raises:
        CalibrationError: of that kind, if it is no such number.

    Example:
        >>> number_of(torch.tensor(60), "fps", what="not a frame rate", expected="a number", least=1, most=1e6)
        60.0
    """
    number = _number(value)
    if number is not None and least <= number <= most:
        return number
    is_array = isinstance(value, list | tuple | set | dict) or getattr(value, "ndim", 0) > 0
    raise error(what, where=where, got=quoted(value), expected=expected, remedy=several if is_array else "")


def index_of(value: Any) -> int | None:
    """A whole number, of Python or numpy or a tensor without dimensions, as Python's own; None if it is none."""
    number = _plain(value)
    if isinstance(number, bool) or not isinstance(number, int | float) or not abs(number) <= _LARGEST_INDEX:
        return None
    return int(number) if number == int(number) else None


def truth_of(value: Any, where: str) -> bool:
    """Yes or no: True or False, 1 or 0.

    Raises:
        ObservationError: if it is neither.
    """
    plain = _plain(value)
    if not isinstance(plain, bool | int) or plain not in (0, 1):
        raise ObservationError("neither yes nor no", where=where, got=quoted(value), expected="True or False")
    return bool(plain)


def names_of(value: Any, where: str, count: int | None = None) -> tuple[str, ...] | None:
    """Different names, in order, and so many where their number is known; None for none.

    Raises:
        ObservationError: if they are not.
    """
    if value is None:
        return None
    given = items_of(value)
    are_names = given is not None and all(isinstance(name, str) or index_of(name) is not None for name in given)
    names = tuple(map(name_of, given or ())) if are_names else ()
    if not are_names or len(names) != (len(names) if count is None else count) or len(set(names)) != len(names):
        got, number = names if are_names else quoted(value), "" if count is None else f"{count} "
        raise ObservationError("names do not fit the keypoints", where=where, got=got, expected=f"{number}different names")
    return names


def items_of(value: Any) -> list[Any] | None:
    """What a list or another collection with an order holds; None if it is none, as a text."""
    if isinstance(value, str | bytes | set | frozenset):
        return None
    try:
        return list(value)
    except Exception:  # what another library raises for its own objects cannot be foreseen
        return None


def name_of(value: Any) -> str:
    """A name as a plain text."""
    return str.__str__(value) if isinstance(value, str) else str(value)


def is_too_far(pixels: Tensor) -> Tensor:
    """Where pixels (..., 2) cannot be keypoints (...), infinite ones among them; False where they are NaN."""
    return (pixels.abs() > FARTHEST_PX).any(-1)


def _tensor(value: Any, where: str, masked: float | None) -> Tensor:
    """An array as a tensor in float32 or float64."""
    if isinstance(value, np.ma.MaskedArray):
        return _without_mask(value, where, masked)
    if isinstance(value, Tensor):
        return _from_tensor(value, where)
    if isinstance(value, list | tuple) and _holds_tensors(value):
        try:
            return torch.stack([_tensor(part, where, masked) for part in value])
        except RuntimeError as error:
            raise _refused(where, f"a list whose parts do not fit together: {error}") from error
    return _from_numpy(value, where)


def _holds_tensors(value: Any) -> bool:
    """Whether a nested list holds tensors or masked arrays, of which numpy would keep neither gradients nor masks."""
    if isinstance(value, list | tuple):
        return any(map(_holds_tensors, value))
    return isinstance(value, Tensor | np.ma.MaskedArray)


def _without_mask(value: np.ma.MaskedArray, where: str, masked: float | None) -> Tensor:
    tensor, mask = _from_numpy(value.data, where), torch.from_numpy(np.array(np.ma.getmaskarray(value)))
    if masked is None and bool(mask.any()):
        raise _refused(where, f"{int(mask.sum())} masked values", expected="a number everywhere")
    return tensor if masked is None else tensor.masked_fill(mask, masked)


def _from_tensor(tensor: Tensor, where: str) -> Tensor:
    if isinstance(tensor, MaskedTensor):
        raise _refused(where, "a MaskedTensor", remedy="Fill it first, as with .to_tensor(torch.nan).")
    if tensor.is_nested:
        raise _refused(where, "a nested tensor", remedy="Make its rows equally long, as with .to_padded_tensor(torch.nan).")
    if tensor.layout != torch.strided:
        raise _refused(where, "a sparse tensor", remedy="Write its zeros out, with .to_dense().")
    if tensor.is_quantized:
        raise _refused(where, "a quantised tensor", remedy="Convert it with .dequantize().")
    if tensor.is_meta:
        raise _refused(where, "a tensor on the meta device, which has no values")
    if not (tensor.is_floating_point() or tensor.dtype in _INTEGERS):
        raise _refused(where, f"a tensor of {tensor.dtype}", remedy="Convert it to real numbers, as with .double().")
    return at_least_float32(tensor.resolve_neg())


def _from_numpy(value: Any, where: str) -> Tensor:
    try:
        array = np.asarray(value)
    except RecursionError:
        raise
    except Exception as error:  # what another library raises for its own arrays cannot be foreseen
        raise _refused(where, f"{type(value).__name__} ({str(error).splitlines()[0] if str(error) else error!r})") from error
    if array.dtype.kind not in "iuf":
        got = type(value).__name__ if array.ndim == 0 else f"an array of {_KINDS.get(array.dtype.kind, array.dtype.name)}"
        raise _refused(where, got, remedy="Convert them to numbers, as with numpy.asarray(values, dtype=float).")
    is_short = array.dtype.kind == "f" and array.dtype.itemsize <= np.dtype(np.float32).itemsize
    with np.errstate(over="ignore"):
        native = np.require(array, np.float32 if is_short else np.float64, ["C", "ALIGNED", "WRITEABLE"])
    return torch.from_numpy(native)


def _refused(where: str, got: str, expected: str = "an array of real numbers", remedy: str = "") -> ObservationError:
    return ObservationError("not an array of numbers", where=where, got=got, expected=expected, remedy=remedy)


def _plain(value: Any) -> Any:
    """A value of numpy or torch without dimensions as Python's own; everything else as it is."""
    if isinstance(value, np.ndarray | np.generic | Tensor) and value.ndim == 0 and not np.ma.is_masked(value):
        try:
            return value.item()
        except (RuntimeError, NotImplementedError):  # it has no value that could be read
            return value
    return value


def _number(value: Any) -> float | None:
    plain = _plain(value)
    if isinstance(plain, bool | np.bool_) or not isinstance(plain, numbers.Real):
        return None
    try:
        number = float(plain)
    except (OverflowError, ValueError, TypeError):
        return None
    return number if math.isfinite(number) else None
