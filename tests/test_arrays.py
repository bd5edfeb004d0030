"""Whatever is handed in as an array, a number or a list becomes a tensor or a plain number, or is refused."""

from __future__ import annotations

import copy
import enum
import pickle
import threading
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch
from torch.masked import masked_tensor

from torchstickcal import CalibrationError, ConfigError, FileFormatError, ObservationError, RigError
from torchstickcal.arrays import index_of, is_too_far, names_of, number_of, tensor_of, truth_of

VALUES = np.array([[1.5, -2.25], [np.nan, 1024.0]])  # exact in every precision that is accepted


class Foreign:
    """An array of another library."""

    def __init__(self, values: np.ndarray, failure: Exception | None = None) -> None:
        self.values, self.failure = values, failure

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if self.failure is not None:
            raise self.failure
        return self.values


def read_only() -> np.ndarray:
    values = VALUES.copy()
    values.flags.writeable = False
    return values


def field_of_records() -> np.ndarray:
    records = np.zeros(VALUES.shape, dtype=[("class", "u1"), ("value", "f8")])
    records["value"] = VALUES
    return records["value"]


def made_in_inference_mode() -> torch.Tensor:
    with torch.inference_mode():
        return torch.tensor(VALUES) * 1


@pytest.mark.parametrize(
    ("value", "dtype"),
    [
        (VALUES, torch.float64),
        (VALUES.tolist(), torch.float64),
        (VALUES[::-1][::-1], torch.float64),
        (VALUES.astype(">f8"), torch.float64),
        (VALUES.astype(">f4"), torch.float32),
        (VALUES.astype(np.longdouble), torch.float64),
        (VALUES.astype(np.float16), torch.float32),
        (np.asfortranarray(VALUES), torch.float64),
        (read_only(), torch.float64),
        (field_of_records(), torch.float64),
        (torch.tensor(VALUES), torch.float64),
        (torch.tensor(VALUES).half(), torch.float32),
        (torch.tensor(VALUES).bfloat16(), torch.float32),
        (torch.nn.Parameter(torch.tensor(VALUES)), torch.float64),
        (made_in_inference_mode(), torch.float64),
        (torch.complex(torch.zeros(2, 2).double(), -torch.tensor(VALUES)).conj().imag, torch.float64),
        ([torch.tensor(row).half() for row in VALUES], torch.float32),
        ((torch.tensor(VALUES[0]).requires_grad_(), VALUES[1].tolist()), torch.float64),
        ([np.ma.masked_invalid(row) for row in VALUES], torch.float64),
        (np.ma.masked_invalid(VALUES.astype(np.float32)), torch.float32),
        (Foreign(VALUES), torch.float64),
    ],
)
def test_arrays_of_every_kind_keep_their_values(value: Any, dtype: torch.dtype, recwarn: pytest.WarningsRecorder):
    tensor = tensor_of(value, "values", masked=torch.nan)
    assert tensor.dtype == dtype
    assert not tensor.requires_grad
    assert not tensor.is_inference()
    np.testing.assert_array_equal(tensor.numpy(), VALUES)
    assert not len(recwarn)


@pytest.mark.parametrize("dtype", [np.int8, np.uint16, np.int64, np.uint64, ">i4"])
def test_integers_become_float64(dtype: Any):
    tensor = tensor_of(np.array([3, 100], dtype=dtype), "values")
    assert (tensor.dtype, tensor.tolist()) == (torch.float64, [3.0, 100.0])


HOLDS_ITSELF: list[Any] = []
HOLDS_ITSELF.append(HOLDS_ITSELF)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "make",
    [
        lambda: None,
        lambda: "abc",
        lambda: VALUES.astype(str),
        lambda: VALUES.astype(object),
        lambda: VALUES.astype(complex),
        lambda: VALUES > 0,
        lambda: np.zeros(2, "M8[s]"),
        lambda: np.zeros(2, "f8,f8"),
        lambda: [[1.0, 2.0], [3.0]],
        lambda: [[1.0, None]],
        lambda: [[10**400]],
        lambda: [torch.zeros(2), torch.zeros(3)],
        lambda: [torch.zeros(2, device="meta")],
        lambda: HOLDS_ITSELF,
        lambda: (row for row in VALUES),
        lambda: {"x": VALUES},
        lambda: Foreign(VALUES, RuntimeError("on another device")),
        lambda: Foreign(VALUES, KeyError()),
        lambda: torch.zeros(2, 2).to_sparse(),
        lambda: torch.eye(2).to_sparse_csr(),
        lambda: torch.zeros(2, device="meta"),
        lambda: torch.quantize_per_tensor(torch.zeros(2), 0.1, 0, torch.quint8),
        lambda: torch.zeros(2, dtype=torch.complex64),
        lambda: torch.zeros(2, dtype=torch.bool),
        lambda: torch.empty(2, dtype=torch.bits8),
        lambda: torch.nested.nested_tensor([torch.zeros(2), torch.zeros(3)]),
        lambda: masked_tensor(torch.zeros(2), torch.tensor([True, False])),
        lambda: np.ma.masked_invalid(VALUES),
    ],
)
def test_what_is_no_array_of_numbers_is_refused_by_name(make: Any):
    with pytest.raises(ObservationError, match=r"not an array of numbers \(values\)"):
        tensor_of(make(), "values")


def test_gradients_flow_back_where_they_are_to():
    rows = [torch.ones(2).half().requires_grad_(), torch.ones(2).requires_grad_()]
    tensor_of(rows, "values", keep_graph=True).square().sum().backward()
    assert [row.grad.tolist() for row in rows] == [[2.0, 2.0], [2.0, 2.0]]


def number(value: Any) -> float:
    return number_of(value, "fps", what="no", expected="a number", least=1, most=100, several="Give several otherwise.")


@pytest.mark.parametrize(
    "value",
    [
        60,
        60.0,
        np.float32(60),
        np.uint8(60),
        np.longdouble(60),
        np.array(60),
        torch.tensor(60.0, requires_grad=True),
        Fraction(60),
    ],
)
def test_numbers_of_every_kind(value: Any):
    assert number(value) == 60.0
    assert type(number(value)) is float


@pytest.mark.parametrize(
    "value",
    [
        None,
        "60",
        True,
        np.True_,
        torch.tensor(True),
        60j,
        float("nan"),
        float("inf"),
        0,
        101,
        10**400,
        pytest.param(-(10**5000), id="5000 digits"),
        np.ma.masked,
        np.ma.array(60.0, mask=True),
        np.datetime64("2020"),
        torch.zeros((), device="meta"),
        object(),
    ],
)
def test_what_is_no_number_is_refused(value: Any):
    with pytest.raises(ObservationError, match=r"no \(fps\)") as caught:
        number(value)
    assert not caught.value.remedy
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("value", [[60, 30], (60,), np.array([60.0]), torch.tensor([60.0]), {60}])
def test_several_numbers_have_a_remedy_of_their_own(value: Any):
    with pytest.raises(ObservationError, match="Give several otherwise"):
        number(value)


def test_indices_names_and_truth():
    assert [index_of(value) for value in (3, 3.0, np.int8(3), torch.tensor(3), np.array(3))] == [3] * 5
    assert {index_of(value) for value in (3.5, True, "3", None, [3], float("nan"), 10**5000, 3j)} == {None}
    joint = enum.Enum("Joint", {"HIP": "hip"}, type=str)
    assert names_of(np.array(["a", "b"]), "names") == ("a", "b")
    assert names_of([joint.HIP, 7], "names", 2) == ("hip", "7")
    assert [truth_of(value, "flag") for value in (True, 0, np.True_, torch.tensor(False))] == [True, False, True, False]
    for value in ("ab", 5, {"a", "b"}, b"ab", [None, "a"], [["a"], ["b"]], ["a", "a"], np.array("ab")):
        with pytest.raises(ObservationError, match="different names"):
            names_of(value, "names", 2)
    for value in ("no", None, 2, [True], np.array([True, False])):
        with pytest.raises(ObservationError, match="neither yes nor no"):
            truth_of(value, "flag")


def test_what_is_too_far_to_be_a_keypoint():
    pixels = torch.tensor([[9e6, 0], [0, -1.1e7], [torch.nan, torch.nan], [torch.inf, torch.nan]])
    assert is_too_far(pixels).tolist() == [False, True, False, True]


class Nasty:
    """Can neither be shown nor sent."""

    def __repr__(self) -> str:
        raise RuntimeError

    def __reduce__(self) -> Any:
        raise KeyError


class OwnError(ObservationError):
    """An error of a plugin, with a signature of its own."""

    def __init__(self, camera: int) -> None:
        super().__init__("no such camera", where="camera", got=camera, expected="0")
        self.camera, self.lock = camera, threading.Lock()


@pytest.mark.parametrize("kind", [CalibrationError, ObservationError, RigError, ConfigError, FileFormatError])
@pytest.mark.parametrize(
    "got",
    [
        None,
        3,
        (1, torch.Size([2])),
        torch.float32,
        lambda: 0,
        threading.Lock(),
        Nasty(),
        pytest.param(10**5000, id="5000 digits"),
        [Nasty()],
    ],
)
def test_errors_can_be_sent_and_copied(kind: type[CalibrationError], got: Any):
    error = kind("what", where="where", got=got, expected="expected", remedy="remedy")
    error.add_note("note")
    copies = [copy.copy(error), copy.deepcopy(error), *(pickle.loads(pickle.dumps(error, protocol)) for protocol in range(6))]
    for same in copies:
        assert (type(same), str(same), same.__notes__) == (kind, str(error), ["note"])
        assert (same.what, same.where, same.expected, same.remedy) == ("what", "where", "expected", "remedy")
        assert same.got == got or isinstance(same.got, str)


def test_own_errors_can_be_sent():
    error = pickle.loads(pickle.dumps(OwnError(3)))
    assert (type(error), error.camera, error.got) == (OwnError, 3, 3)
    assert isinstance(error.lock, str)


def test_long_values_are_cut_in_messages():
    assert len(str(ObservationError("what", where="where", got=list(range(10**5)), expected="expected"))) < 1000
