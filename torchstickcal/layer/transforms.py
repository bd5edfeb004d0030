"""What torch does with a layer beside ``backward``: torch.func, forward-mode and second derivatives, compiled graphs.

Sessions are calibrated in threads of their own, which the transforms of torch.func do not reach. Under a transform the layer
is therefore one ``autograd.Function`` on plain tensors. Its forward pass calibrates and keeps the graph. Its backward pass, a
second ``autograd.Function``, goes through that graph. ``torch.func.vmap`` calibrates all sessions as one batch.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn, ParamSpec, TypeVar

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor
from torch.autograd import forward_ad
from torch.utils import _pytree as pytree

from torchstickcal.errors import CalibrationError
from torchstickcal.layer.inputs import LayerInputs
from torchstickcal.layer.result import LayerResult
from torchstickcal.quality.verdict import Quality

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
_NO_GRAPH = "a calibration runs between compiled graphs, not inside of one: its steps depend on the keypoints"
_NO_EXPORT = "a calibration cannot be exported as a graph: its steps depend on the keypoints"
_eager: dict[Any, Any] = {}
"""Functions by themselves, in the form that torch.compile leaves alone."""


def calibrated_in_any_transform(calibrated: Callable[[LayerInputs], LayerResult], given: LayerInputs) -> LayerResult:
    """The result for the arguments of a layer, under whichever transforms of torch it is called.

    Args:
        calibrated: calibrates sessions of plain tensors, with a graph.
        given: the arguments.

    Raises:
        CalibrationError: in the forward or backward pass, for forward-mode and second derivatives.
    """
    tensors = given.tensors()
    if torch._C._are_functorch_transforms_active() or any(map(_is_dual, tensors.values())):
        call = _Call(calibrated, given)
        found = _Calibrated.apply(call, *tensors.values())
        return LayerResult.of_tensors(dict(zip(call.outputs, found, strict=True)), call.status, call.qualities)
    return calibrated(given.with_tensors({name: _Once.apply(tensor) for name, tensor in tensors.items()}))


def is_transformed(value: Any) -> bool:
    """Whether a transform of torch.func has wrapped a tensor of a pytree."""
    leaves = (leaf for leaf in pytree.tree_leaves(value) if isinstance(leaf, Tensor))
    return any(is_functorch_wrapped_tensor(leaf) for leaf in leaves)


def outside_graphs(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """A function that ``torch.compile`` runs as it is, between two compiled graphs.

    Raises:
        CalibrationError: if it is being exported or traced: a calibration is a search whose steps depend on the numbers.
    """
    if (torch.compiler.is_exporting() or torch.jit.is_tracing()) and not torch.compiler.is_dynamo_compiling():
        raise CalibrationError(
            _NO_EXPORT,
            where="CalibrationLayer",
            got="torch.export, torch.onnx.export or torch.jit.trace",
            expected="a call in Python",
            remedy="Export the network without the layer, and call the layer on what the exported network gives.",
        )
    if function not in _eager:
        if "torch._dynamo" not in sys.modules:  # to import it would take seconds
            return function
        torch._dynamo.graph_break(msg=_NO_GRAPH)
        _eager[function] = torch.compiler.disable(function, reason=_NO_GRAPH)
    return _eager[function]


class _Call:
    """One call of a layer: from the forward pass to its backward passes."""

    def __init__(self, calibrated: Callable[[LayerInputs], LayerResult], given: LayerInputs) -> None:
        self._calibrated, self._given, self._names = calibrated, given, tuple(given.tensors())
        self.outputs: dict[str, Tensor] = {}
        self.status: tuple[str, ...] = ()
        self.qualities: tuple[Quality, ...] | None = None
        self._leaves: list[Tensor] = []

    def run(self, tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Calibrate plain tensors, and keep the graph."""
        self._leaves = [tensor.detach().requires_grad_() for tensor in tensors]
        with torch.enable_grad():
            result = self._calibrated(self._given.with_tensors(dict(zip(self._names, self._leaves, strict=True))))
        self.outputs, self.status, self.qualities = result.tensors(), result.status, result.qualities
        return tuple(tensor.detach() for tensor in self.outputs.values())

    def gradients(self, by_outputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Gradients with respect to the tensors that were calibrated."""
        outputs = [(value, by) for value, by in zip(self.outputs.values(), by_outputs, strict=True) if value.requires_grad]
        values, directions = [value for value, _ in outputs], [by for _, by in outputs]
        return torch.autograd.grad(
            values, self._leaves, directions, retain_graph=True, allow_unused=True, materialize_grads=True
        )


class _Calibrated(torch.autograd.Function):
    """The layer under transforms of torch.func."""

    @staticmethod
    def forward(call: _Call, *tensors: Tensor) -> tuple[Tensor, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return call.run(tensors)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.call = inputs[0]
        ctx.save_for_backward(*inputs[1:])
        ctx.mark_non_differentiable(*(tensor for tensor in output if not tensor.is_floating_point()))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return None, *_Gradients.apply(ctx.call, len(ctx.saved_tensors), *ctx.saved_tensors, *gradients)

    @staticmethod
    def vmap(info: Any, in_dims: Any, call: _Call, *tensors: Tensor) -> tuple[Any, Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        found = _Calibrated.apply(call, *_merged(info, in_dims[1:], tensors))
        return _parted(info, found)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> NoReturn:  # pyright: ignore[reportIncompatibleMethodOverride]
        raise CalibrationError(
            "the layer has no forward-mode derivatives",
            where="CalibrationLayer",
            got="torch.func.jvp, jacfwd, hessian or a dual tensor",
            expected="reverse mode",
            remedy="Use torch.func.grad, vjp or jacrev, or backward().",
        )


class _Gradients(torch.autograd.Function):
    """The backward pass of :class:`_Calibrated`."""

    @staticmethod
    def forward(call: _Call, inputs: int, *tensors: Tensor) -> tuple[Tensor, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return call.gradients(tensors[inputs:])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        """Nothing is needed: there is no second derivative."""

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> NoReturn:  # pyright: ignore[reportIncompatibleMethodOverride]
        _refuse_second_derivatives()

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> NoReturn:  # pyright: ignore[reportIncompatibleMethodOverride]
        _refuse_second_derivatives()

    @staticmethod
    def vmap(info: Any, in_dims: Any, call: _Call, inputs: int, *tensors: Tensor) -> tuple[Any, Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        dims = in_dims[2:]
        if any(dim is not None for dim in dims[:inputs]):  # more sessions
            return _parted(info, _Gradients.apply(call, inputs, *_merged(info, dims, tensors)))
        directions = [[_chosen(t, dim, n) for t, dim in zip(tensors, dims, strict=True)] for n in range(info.batch_size)]
        found = [_Gradients.apply(call, inputs, *direction) for direction in directions]
        return tuple(torch.stack(parts) for parts in zip(*found, strict=True)), (0,) * inputs


class _Once(torch.autograd.Function):
    """The same tensor, whose gradient cannot be differentiated: that of the layer would lack terms."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return tensor.view_as(tensor)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return _Last.apply(gradient.detach().requires_grad_()) if torch.is_grad_enabled() else gradient


class _Last(torch.autograd.Function):
    """The same gradient; to differentiate it is an error."""

    @staticmethod
    def forward(ctx: Any, gradient: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return gradient.view_as(gradient)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> NoReturn:  # pyright: ignore[reportIncompatibleMethodOverride]
        _refuse_second_derivatives()


def _refuse_second_derivatives() -> NoReturn:
    raise CalibrationError(
        "the layer has no second derivatives",
        where="CalibrationLayer",
        got="the derivative of a gradient: create_graph=True, or a transform of torch.func inside another",
        expected="first derivatives",
        remedy="Use differences of gradients, or a loss that does not contain gradients of the layer.",
    )


def _is_dual(tensor: Tensor) -> bool:
    return forward_ad.unpack_dual(tensor).tangent is not None


def _merged(info: Any, dims: Sequence[int | None], tensors: Sequence[Tensor]) -> list[Tensor]:
    """Tensors (B, ...) with another dimension for more sessions, or alike for all of them, as (n B, ...)."""
    stacked = (
        tensor.expand(info.batch_size, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
        for tensor, dim in zip(tensors, dims, strict=True)
    )
    return [tensor.flatten(0, 1) for tensor in stacked]


def _parted(info: Any, tensors: Sequence[Tensor]) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    """Tensors (n B, ...) as (n, B, ...), and where the n are."""
    return tuple(tensor.unflatten(0, (info.batch_size, -1)) for tensor in tensors), (0,) * len(tensors)


def _chosen(tensor: Tensor, dim: int | None, number: int) -> Tensor:
    return tensor if dim is None else tensor.select(dim, number)
