"""A policy's network as a graph of ONNX operators, run node by node: by NumPy on the robot, by JAX in evaluation.

Nodes are dicts {"op", "inputs", "outputs", "attributes"}; names refer to graph inputs, initialisers and outputs of
earlier nodes. An operator and its attributes mean what they mean in ONNX (where newer versions of ONNX want a constant
input in place of an attribute, the attribute is kept). Everything is float32 and for one robot: no batch axis.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

Array = Any
Kernel = Callable[..., Any]

INPUTS = ("observation", "memory")
OUTPUTS = ("action", "memory_out")


class GraphError(ValueError):
    """A graph that can't be run; the text says why."""


def _elu(x: Array) -> Array:
    xp = x.__array_namespace__()
    return xp.maximum(x, 0.0) + xp.expm1(xp.minimum(x, 0.0))


def _sigmoid(x: Array) -> Array:
    # 1 / (1 + exp(-x)), without the overflow.
    return 0.5 + 0.5 * x.__array_namespace__().tanh(0.5 * x)


def _layer_normalization(x: Array, scale: Array, bias: Array, epsilon: float) -> Array:
    xp, share = x.__array_namespace__(), 1.0 / x.shape[-1]
    x = x - share * x.sum(axis=-1, keepdims=True)
    return x / xp.sqrt(share * (x * x).sum(axis=-1, keepdims=True) + epsilon) * scale + bias


def _simple(function: Kernel) -> Callable[[dict[str, Any]], Kernel]:
    return lambda attributes: function


def _last_axis(attributes: dict[str, Any]) -> None:
    axis = attributes.pop("axis", None) if "axis" in attributes else attributes.pop("axes", [None])[0]
    if axis != -1:
        raise GraphError(f"axis {axis} isn't supported; choose -1")


def _concat(attributes: dict[str, Any]) -> Kernel:
    _last_axis(attributes)
    return lambda *x: x[0].__array_namespace__().concatenate(x, axis=-1)


def _slice(attributes: dict[str, Any]) -> Kernel:
    _last_axis(attributes)
    (start,), (end,) = attributes.pop("starts"), attributes.pop("ends")
    return lambda x: x[..., start:end]


def _split(attributes: dict[str, Any]) -> Kernel:
    _last_axis(attributes)
    sizes = [int(size) for size in attributes.pop("split")]
    ends = [sum(sizes[: i + 1]) for i in range(len(sizes))]
    if len(sizes) == 1:
        return lambda x: x
    parts = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]

    def split(x: Array) -> list[Array]:
        if x.shape[-1] != ends[-1]:
            raise GraphError(f"can't split {x.shape[-1]} values into {sizes}")
        return [x[..., part] for part in parts]

    return split


def _reshape(attributes: dict[str, Any]) -> Kernel:
    shape = tuple(int(size) for size in attributes.pop("shape"))
    return lambda x: x.__array_namespace__().reshape(x, shape)


def _gather(attributes: dict[str, Any]) -> Kernel:
    _last_axis(attributes)
    indices = [int(index) for index in attributes.pop("indices")]
    highest = max(indices, default=0)
    if min(indices, default=0) < 0:
        raise GraphError("Gather takes indices from 0 on")

    def gather(x: Array) -> Array:
        if x.shape[-1] <= highest:  # JAX would clamp it
            raise GraphError(f"can't take value {highest} of {x.shape[-1]}")
        return x[..., x.__array_namespace__().asarray(indices)]

    return gather


def _clip(attributes: dict[str, Any]) -> Kernel:
    low, high = float(attributes.pop("min")), float(attributes.pop("max"))
    return lambda x: x.__array_namespace__().clip(x, low, high)


def _normalization(attributes: dict[str, Any]) -> Kernel:
    _last_axis(attributes)
    epsilon = float(attributes.pop("epsilon"))
    return lambda x, scale, bias: _layer_normalization(x, scale, bias, epsilon)


OPERATORS: dict[str, tuple[int | None, Callable[[dict[str, Any]], Kernel]]] = {
    "Add": (2, _simple(lambda a, b: a + b)),
    "Clip": (1, _clip),
    "Concat": (None, _concat),
    "Div": (2, _simple(lambda a, b: a / b)),
    "Elu": (1, _simple(_elu)),
    "Gather": (1, _gather),
    "Identity": (1, _simple(lambda x: x)),
    "LayerNormalization": (3, _normalization),
    "MatMul": (2, _simple(lambda a, b: a @ b)),
    "Mul": (2, _simple(lambda a, b: a * b)),
    "Reshape": (1, _reshape),
    "Sigmoid": (1, _simple(_sigmoid)),
    "Slice": (1, _slice),
    "Split": (1, _split),
    "Sub": (2, _simple(lambda a, b: a - b)),
    "Tanh": (1, _simple(lambda x: x.__array_namespace__().tanh(x))),
}
"""Number of inputs (None: any) and maker of the function, by name."""


class Graph:
    """A checked graph, ready to run: `graph(observation, memory) -> (action, memory_out)`."""

    def __init__(self, nodes: Sequence[Mapping[str, Any]], initialisers: Mapping[str, Array]):
        """Raises GraphError where the nodes make no graph.

        Args:
          nodes: in an order in which they can run.
          initialisers: float32 arrays by name.
        """
        self.nodes = nodes
        places = {name: i for i, name in enumerate([*INPUTS, *initialisers])}
        self._start = [None, None, *initialisers.values()]
        self._steps: list[tuple[Kernel, list[int], list[int]]] = []
        for number, node in enumerate(nodes):
            try:
                self._steps.append(_compile(node, places))
            except GraphError as error:
                raise GraphError(f"node {number}: {error}") from None
            except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
                raise GraphError(f"node {number} is malformed ({type(error).__name__}: {error})") from None
        missing = [name for name in OUTPUTS if name not in places]
        if missing:
            raise GraphError(f"no node gives '{missing[0]}'")
        self._space = [None] * (len(places) - len(self._start))
        self._out = [places[name] for name in OUTPUTS]

    def __call__(self, observation: Array, memory: Array) -> tuple[Array, Array]:
        """One step of the policy.

        Args:
          observation: (S,) float32, NumPy or JAX.
          memory: (M,) float32, what the last step returned, zeros at first.

        Returns:
          The action (14,) in (-1, 1), the mean of the policy, and the next memory (M,).
        """
        values = self._start + self._space
        values[0], values[1] = observation, memory
        for function, inputs, outputs in self._steps:
            result = function(*[values[i] for i in inputs])
            if len(outputs) == 1:
                values[outputs[0]] = result
            else:
                for i, part in zip(outputs, result, strict=True):
                    values[i] = part
        return values[self._out[0]], values[self._out[1]]


def _compile(node: Mapping[str, Any], places: dict[str, int]) -> tuple[Kernel, list[int], list[int]]:
    """Function, places of its inputs and outputs; adds the outputs to the places."""
    op, attributes = node["op"], dict(node.get("attributes", {}))
    if op not in OPERATORS:
        raise GraphError(f"unknown operator '{op}'; choose one of {', '.join(OPERATORS)}")
    count, make = OPERATORS[op]
    inputs, outputs = list(node["inputs"]), list(node["outputs"])
    wanted = len(attributes.get("split", [0])) if op == "Split" else 1
    if count not in (None, len(inputs)) or not inputs or len(outputs) != wanted:
        raise GraphError(f"{op} has {len(inputs)} inputs and {len(outputs)} outputs")
    for name in inputs:
        if name not in places:
            raise GraphError(f"{op} reads '{name}', which nothing before it gives")
    function = make(attributes)
    if attributes:
        raise GraphError(f"{op} has an unknown attribute '{next(iter(attributes))}'")
    for name in outputs:
        if name in places:
            raise GraphError(f"{op} gives '{name}', which exists already")
        places[name] = len(places)
    return function, [places[name] for name in inputs], [places[name] for name in outputs]
