"""A JAX function as an ONNX graph with a free batch size.

The function is traced with a symbolic batch size. Values that depend only on constants are computed now and stored as
numbers. Every other primitive becomes nodes of the graph. A `scan` is unrolled. CALLS are inlined, as in rounding.py.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.export
import numpy as np

from beliefrl.errors import UserError

OPSET = 18  # understood by onnxruntime 1.14 and later
BATCH = "batch"  # name of the free dimension

NODES = ("Add", "Sub", "Mul", "Div", "Max", "Min", "Pow", "Neg", "Abs", "Sign", "Floor", "Ceil", "Exp", "Log", "Sqrt")
FUNCTIONS = ("Sin", "Cos", "Tan", "Tanh", "Erf", "And", "Or", "Xor", "Not")
COMPARE = {"eq": "Equal", "lt": "Less", "le": "LessOrEqual", "gt": "Greater", "ge": "GreaterOrEqual"}
SAME = (
    {node.lower(): node for node in NODES + FUNCTIONS}
    | COMPARE
    | {"logistic": "Sigmoid", "copy": "Identity", "stop_gradient": "Identity"}
)
REDUCE = {"reduce_sum": "ReduceSum", "reduce_max": "ReduceMax", "reduce_min": "ReduceMin", "reduce_prod": "ReduceProd"}
CALLS = ("jit", "pjit", "closed_call", "checkpoint", "remat2", "custom_jvp_call", "custom_vjp_call")

# A value is the name of a tensor in the graph, or a function that returns a constant, computed at its first use.
Value = str | Callable[[], Any]


def model(
    onnx: Any,
    function: Callable[..., Sequence[Any]],
    inputs: dict[str, tuple[tuple[int, ...], Any]],
    outputs: Sequence[str],
    about: dict[str, str],
) -> bytes:
    """The ONNX model of a function of arrays (batch, ...).

    Args:
        onnx: the module.
        function: of the inputs in this order; returns the outputs.
        inputs: name of each, with its shape without the batch, and its dtype.
        outputs: their names.
        about: texts that are stored in the model.

    Raises:
        UserError: the function uses a primitive that is not supported.
    """
    (batch,) = jax.export.symbolic_shape(BATCH)
    shapes = [jax.ShapeDtypeStruct((batch, *shape), kind) for shape, kind in inputs.values()]
    closed = jax.make_jaxpr(function)(*shapes)
    graph = _Graph(onnx, next(iter(inputs)))
    results = graph.run(closed.jaxpr, closed.consts, list(inputs))
    for name, value in zip(outputs, results, strict=True):
        graph.nodes.append(onnx.helper.make_node("Identity", [graph.tensor(value)], [name]))

    def described(name: str, aval: Any) -> Any:
        kind = onnx.helper.np_dtype_to_tensor_dtype(np.dtype(aval.dtype))
        return onnx.helper.make_tensor_value_info(name, kind, [BATCH, *map(int, aval.shape[1:])])

    nodes, constants = graph.needed(outputs)
    made = onnx.helper.make_graph(
        nodes,
        "policy",
        [described(name, aval) for name, aval in zip(inputs, closed.in_avals, strict=True)],
        [described(name, aval) for name, aval in zip(outputs, closed.out_avals, strict=True)],
        constants,
    )
    whole = onnx.helper.make_model(
        made, opset_imports=[onnx.helper.make_opsetid("", OPSET)], producer_name="beliefrl", ir_version=8
    )
    onnx.helper.set_model_props(whole, about)
    onnx.checker.check_model(whole)
    return whole.SerializeToString()


class _Graph:
    """Nodes and constants so far, and how each primitive adds to them."""

    def __init__(self, onnx: Any, batched: str):
        """`batched` is an input whose first dimension is the batch."""
        self.onnx, self.batched = onnx, batched
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}
        self._names = (f"v{index}" for index in itertools.count())

    def node(self, kind: str, *inputs: Value, outputs: int = 1, **attributes: Any) -> Any:
        """Add a node; returns the name of its output, or a list if there are several `outputs`."""
        names = [next(self._names) for _ in range(outputs)]
        self.nodes.append(self.onnx.helper.make_node(kind, list(map(self.tensor, inputs)), names, **attributes))
        return names[0] if outputs == 1 else names

    def tensor(self, value: Value) -> str:
        """The name of a value in the graph; a constant is added to it."""
        return value if isinstance(value, str) else self.constant(value())

    def constant(self, array: Any) -> str:
        """The name of a new constant."""
        name = next(self._names)
        self.constants[name] = self.onnx.numpy_helper.from_array(np.asarray(array), name)
        return name

    def needed(self, outputs: Sequence[str]) -> tuple[list[Any], list[Any]]:
        """The nodes and constants on which the outputs depend."""
        wanted, nodes = set(outputs), []
        for node in reversed(self.nodes):
            if wanted.intersection(node.output):
                wanted.update(node.input)
                nodes.append(node)
        return nodes[::-1], [constant for name, constant in self.constants.items() if name in wanted]

    def shape(self, dimensions: Sequence[Any]) -> str:
        """A shape as a tensor of integers; the batch size is read from an input."""
        parts = [self.constant(np.array([each], np.int64)) if _is_fixed(each) else self.batch for each in dimensions]
        return self.node("Concat", *parts, axis=0) if parts else self.constant(np.zeros(0, np.int64))

    @functools.cached_property
    def batch(self) -> str:
        """The batch size."""
        return self.node("Shape", self.batched, start=0, end=1)

    def run(self, jaxpr: Any, constants: Sequence[Any], inputs: Sequence[Value]) -> list[Value]:
        """Add the equations of a jaxpr; returns its outputs."""
        values: dict[Any, Value] = {}

        def read(variable: Any) -> Value:
            literal = hasattr(variable, "val")
            return (lambda: np.asarray(variable.val, variable.aval.dtype)) if literal else values[variable]

        values.update(
            zip(jaxpr.constvars, (functools.partial(jax.numpy.asarray, each) for each in constants), strict=True)
        )
        values.update(zip(jaxpr.invars, inputs, strict=True))
        for equation in jaxpr.eqns:
            given = [read(variable) for variable in equation.invars]
            values.update(zip(equation.outvars, self.equation(equation, given), strict=True))
        return [read(variable) for variable in jaxpr.outvars]

    def equation(self, equation: Any, inputs: list[Value]) -> list[Value]:
        """Add one equation; returns its outputs."""
        name, parameters = equation.primitive.name, equation.params
        if name in CALLS:
            inner = next(parameters[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in parameters)
            return self.run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), inputs)
        if name == "scan":
            return self.scan(parameters, inputs)
        sizes = (size for variable in equation.outvars for size in variable.aval.shape)
        if all(map(callable, inputs)) and all(map(_is_fixed, sizes)):
            return _computed(equation, inputs)
        if name in SAME:
            return [self.node(SAME[name], *inputs)]
        if name in REDUCE:
            axes = self.constant(np.array(parameters["axes"], np.int64))
            return [self.node(REDUCE[name], inputs[0], axes, keepdims=0)]
        if not hasattr(self, f"do_{name}"):
            raise UserError(f"This agent cannot be exported to ONNX (it uses {name}): export it as a .jax file.")
        avals = [variable.aval for variable in equation.invars]
        made = getattr(self, f"do_{name}")(inputs, avals, equation.outvars[0].aval, parameters)
        return made if isinstance(made, list) else [made]

    def scan(self, parameters: dict[str, Any], inputs: list[Value]) -> list[Value]:
        """All steps of a scan, one after the other."""
        constants, carried = parameters["num_consts"], parameters["num_consts"] + parameters["num_carry"]
        steps = range(parameters["length"])
        carry, rows = inputs[constants:carried], []
        for index in reversed(steps) if parameters["reverse"] else steps:
            now = [self.entry(value, index) for value in inputs[carried:]]
            results = self.run(
                parameters["jaxpr"].jaxpr, parameters["jaxpr"].consts, [*inputs[:constants], *carry, *now]
            )
            carry = results[: parameters["num_carry"]]
            rows.append([self.node("Unsqueeze", each, _integers(0)) for each in results[parameters["num_carry"] :]])
        rows = rows[::-1] if parameters["reverse"] else rows
        return [*carry, *(self.node("Concat", *column, axis=0) for column in zip(*rows, strict=True))]

    def entry(self, value: Value, index: int) -> Value:
        """The entry of a value along its first axis."""
        if callable(value):
            return lambda: value()[index]
        return self.node("Gather", value, lambda: np.int64(index), axis=0)

    # One method for each primitive that is not one node: (inputs, their types, type of the output, parameters)

    def do_ne(self, inputs, avals, out, parameters):
        return self.node("Not", self.node("Equal", *inputs))

    def do_log1p(self, inputs, avals, out, parameters):
        return self.node("Log", self.node("Add", inputs[0], _like(out, 1)))

    def do_expm1(self, inputs, avals, out, parameters):
        return self.node("Sub", self.node("Exp", inputs[0]), _like(out, 1))

    def do_rsqrt(self, inputs, avals, out, parameters):
        return self.node("Reciprocal", self.node("Sqrt", inputs[0]))

    def do_integer_pow(self, inputs, avals, out, parameters):
        return self.node("Pow", inputs[0], _like(out, parameters["y"]))

    def do_square(self, inputs, avals, out, parameters):
        return self.node("Mul", inputs[0], inputs[0])

    def do_clamp(self, inputs, avals, out, parameters):
        low, value, high = inputs
        return self.node("Min", self.node("Max", value, low), high)

    def do_select_n(self, inputs, avals, out, parameters):
        which, *cases = inputs
        chosen = np.unique(which()) if not isinstance(which, str) else ()
        if len(chosen) == 1:  # such as the action's noise, which is 0
            return cases[int(chosen[0])]
        if len(cases) != 2:
            raise UserError("This agent cannot be exported to ONNX (it selects from many): export it as a .jax file.")
        return self.node("Where", which, cases[1], cases[0])

    def do_convert_element_type(self, inputs, avals, out, parameters):
        return self.node("Cast", inputs[0], to=self.onnx.helper.np_dtype_to_tensor_dtype(np.dtype(out.dtype)))

    def do_reshape(self, inputs, avals, out, parameters):
        return self.node("Reshape", inputs[0], self.shape(out.shape), allowzero=1)

    do_squeeze = do_expand_dims = do_reshape

    def do_broadcast_in_dim(self, inputs, avals, out, parameters):
        shape = [1] * len(out.shape)
        for axis, size in zip(parameters["broadcast_dimensions"], avals[0].shape, strict=True):
            shape[axis] = size
        reshaped = self.node("Reshape", inputs[0], self.shape(shape), allowzero=1)
        return reshaped if tuple(shape) == tuple(out.shape) else self.node("Expand", reshaped, self.shape(out.shape))

    def do_transpose(self, inputs, avals, out, parameters):
        return self.node("Transpose", inputs[0], perm=list(map(int, parameters["permutation"])))

    def do_slice(self, inputs, avals, out, parameters):
        starts, ends = self.shape(parameters["start_indices"]), self.shape(parameters["limit_indices"])
        steps = parameters["strides"] or (1,) * len(out.shape)
        return self.node("Slice", inputs[0], starts, ends, _integers(*range(len(steps))), _integers(*steps))

    def do_rev(self, inputs, avals, out, parameters):
        axes, least = parameters["dimensions"], np.iinfo(np.int64).min
        starts, stops, steps = (_integers(*(number,) * len(axes)) for number in (-1, least, -1))
        return self.node("Slice", inputs[0], starts, stops, _integers(*axes), steps)

    def do_concatenate(self, inputs, avals, out, parameters):
        return self.node("Concat", *inputs, axis=int(parameters["dimension"]))

    def do_split(self, inputs, avals, out, parameters):
        sizes = parameters["sizes"]
        return self.node("Split", inputs[0], _integers(*sizes), outputs=len(sizes), axis=int(parameters["axis"]))

    def do_stack(self, inputs, avals, out, parameters):
        rows = (self.node("Unsqueeze", each, _integers(parameters["axis"])) for each in inputs)
        return self.node("Concat", *rows, axis=int(parameters["axis"]))

    def do_dot_general(self, inputs, avals, out, parameters):
        """The product as a product of matrices: the other axes of each factor become one."""
        contracted, batched = parameters["dimension_numbers"]
        factors = []
        for side, value in enumerate(inputs):
            axes, shared, shape = contracted[side], batched[side], avals[side].shape
            rest = [axis for axis in range(len(shape)) if axis not in (*axes, *shared)]
            order = [*shared, *(axes if side else rest), *(rest if side else axes)]
            turned = self.node("Transpose", value, perm=list(map(int, order)))
            product = math.prod(shape[axis] for axis in axes)
            sizes = [product, -1] if side else [-1, product]  # -1: the rest
            factors.append(self.node("Reshape", turned, self.shape([*(shape[axis] for axis in shared), *sizes])))
        return self.node("Reshape", self.node("MatMul", *factors), self.shape(out.shape))


def _computed(equation: Any, inputs: list[Any]) -> list[Value]:
    """The outputs of an equation of constants, computed when one of them is used."""

    @functools.cache
    def results() -> list[Any]:
        found = equation.primitive.bind(*(each() for each in inputs), **equation.params)
        return found if equation.primitive.multiple_results else [found]

    return [functools.partial(lambda index: results()[index], index) for index in range(len(equation.outvars))]


def _like(aval: Any, number: int | float) -> Value:
    """A constant of the type of a value."""
    return lambda: np.asarray(number, aval.dtype)


def _integers(*numbers: Any) -> Value:
    return lambda: np.array(numbers, np.int64)


def _is_fixed(dimension: Any) -> bool:
    """Whether a dimension is a number and not the batch."""
    if not isinstance(dimension, int | np.integer) and str(dimension) != BATCH:
        raise UserError("This agent cannot be exported to ONNX (it mixes episodes): export it as a .jax file.")
    return isinstance(dimension, int | np.integer)
