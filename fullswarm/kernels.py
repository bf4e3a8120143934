"""Kernels: small loops over arrays that run as plain Python on a robot and compiled in a lockstep trial.

One source, two speeds. A robot evaluates its laws for itself alone, where plain Python is fast enough and
importing a compiler would cost it 100 MB. A trial evaluates them for the whole swarm thousands of times per
second, so :func:`compile_all` compiles every kernel with numba (extra ``[sim]``), cached on disk.
"""

from __future__ import annotations
import __future__

import ast
import hashlib
import inspect
import textwrap
import types
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar, get_type_hints

import numpy as np
import platformdirs
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Flags = NDArray[np.bool_]
"""The arrays of the whole package: what a kernel takes and a behaviour returns."""

Fields = Mapping[str, tuple[str, ...]]
"""The fields of named tuples, by the name of the parameter."""

P = ParamSpec("P")
R = TypeVar("R")
Arrays = TypeVar("Arrays", bound=NamedTuple)

_ALL: list[Kernel[Any, Any]] = []
_compiled = False


class Kernel(Generic[P, R]):
    """A function that numba can compile; calls go to the compiled form once there is one.

    A kernel may call other kernels: name them as globals of its module, above it. Arguments are numbers and arrays.
    """

    def __init__(self, function: Callable[P, R]) -> None:
        # Calls from kernel to kernel go to the plain forms at once: by way of `__call__` each takes four times as long.
        self.plain: Callable[P, R] = _linked(function, "plain")
        self.run: Callable[P, R] = self.plain
        self.compiled: Callable[P, R] = self.plain
        self.__doc__ = function.__doc__
        self.__name__ = getattr(function, "__name__", "kernel")
        self.__wrapped__ = function
        _ALL.append(self)
        if _compiled:
            self.compile()

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Run the compiled form if there is one, else the plain one."""
        return self.run(*args, **kwargs)

    def compile(self) -> None:
        """Replace the plain form by numba's; kernels it calls are compiled first."""
        if self.run is not self.plain:
            return
        import numba

        for other in _called(self.__wrapped__).values():
            other.compile()
        fields = _tuple_fields(self.__wrapped__)
        source = _flattened(self.__wrapped__, fields)
        options: dict[str, Any] = {} if _allocates(self.__wrapped__) else {"_nrt": False}
        self.compiled = numba.njit(cache=True, error_model="numpy", forceinline=bool(fields), **options)(
            _linked(source, "compiled")
        )
        self.run = self.compiled
        if fields:
            takes = {name: name in fields for name in inspect.signature(self.__wrapped__).parameters}
            self.run = _taking_tuples(self.compiled, takes)
            _TAKES[self.run] = self.compiled, takes


def _called(source: Any) -> dict[str, Kernel[Any, Any]]:
    """Return the kernels that a function names."""
    named = {name: source.__globals__.get(name) for name in source.__code__.co_names}
    return {name: other for name, other in named.items() if isinstance(other, Kernel)}


def _allocates(source: Any) -> bool:
    """Tell whether a kernel, or one that it calls, makes arrays; only then references to arrays need to be counted.

    A count is an atomic operation: they took a third of the time of a kernel with many arrays.
    """
    if not {"np", "copy"}.isdisjoint(source.__code__.co_names):
        return True
    return any(_allocates(other.__wrapped__) for other in _called(source).values())


def _linked(source: Any, form: str) -> Any:
    """Return a function with the `plain` or the `compiled` form of each kernel that it names in the kernel's place."""
    names = source.__globals__ | {name: getattr(other, form) for name, other in _called(source).items()}
    linked = types.FunctionType(source.__code__, names, source.__name__, source.__defaults__)
    linked.__module__, linked.__qualname__ = source.__module__, source.__qualname__
    return linked


def _tuple_fields(source: Any) -> dict[str, tuple[str, ...]]:
    """Return the fields of each parameter that is a named tuple."""
    kinds = get_type_hints(source)
    return {name: kind._fields for name, kind in kinds.items() if name != "return" and hasattr(kind, "_fields")}


class _Flattening(ast.NodeTransformer):
    """Replaces the named tuples of a kernel by their members: in its parameters, its body and its calls of kernels."""

    def __init__(
        self, fields: Mapping[str, tuple[str, ...]], called: Mapping[str, Mapping[str, tuple[str, ...]]]
    ) -> None:
        self._fields, self._called = fields, called

    def _members(self, name: str, ctx: ast.expr_context) -> list[ast.expr]:
        return [ast.Name(f"{name}__{field}", ctx) for field in self._fields[name]]

    def visit_arguments(self, node: ast.arguments) -> ast.AST:
        """Take the members one by one."""
        names = [
            name
            for each in node.args
            for name in ([f"{each.arg}__{field}" for field in self._fields.get(each.arg, ())] or [each.arg])
        ]
        return ast.arguments([], [ast.arg(name) for name in names], None, [], [], None, node.defaults)

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        """Read a member."""
        if isinstance(node.value, ast.Name) and node.value.id in self._fields:
            return ast.copy_location(ast.Name(f"{node.value.id}__{node.attr}", node.ctx), node)
        return self.generic_visit(node)

    def visit_Name(self, node: ast.Name) -> ast.AST:
        """Make a tuple of the members where the whole is meant, as for unpacking it."""
        if node.id not in self._fields:
            return node
        return ast.copy_location(ast.Tuple(self._members(node.id, ast.Load()), ast.Load()), node)

    def visit_Call(self, node: ast.Call) -> ast.AST:
        """Pass the members to a kernel one by one."""
        if isinstance(node.func, ast.Name) and node.func.id in self._called:
            kinds = self._called[node.func.id]
            given = list(zip(node.args, kinds.values(), strict=True))
            node.args = [each for value, kind in given for each in (self._passed(value, kind) if kind else [value])]
        return self.generic_visit(node)

    def _passed(self, value: ast.expr, kind: tuple[str, ...]) -> list[ast.expr]:
        if not isinstance(value, ast.Name):
            raise TypeError(f"line {value.lineno}: give a kernel a named tuple by its name")
        if value.id in self._fields:
            return self._members(value.id, ast.Load())
        return [ast.Attribute(value, field, ast.Load()) for field in kind]


def _flattened(source: Any, fields: Mapping[str, tuple[str, ...]]) -> Any:
    """Return a kernel's function that takes the members of its named tuples one by one.

    numba takes some ten times as long for an array in a tuple as for an array: to find its type at each call, and to
    count references to it in each turn of a loop. The code keeps file and lines, by which numba finds its cache and
    reports errors.
    """
    called = {name: _parameter_fields(other.__wrapped__) for name, other in _called(source).items()}
    if not fields and not any(any(kinds.values()) for kinds in called.values()):
        return source
    tree = ast.parse(textwrap.dedent(inspect.getsource(source)))
    definition = tree.body[0]
    if isinstance(definition, ast.FunctionDef):
        definition.decorator_list = []
    ast.increment_lineno(tree, source.__code__.co_firstlineno - 1)
    whole = ast.fix_missing_locations(_Flattening(fields, called).visit(tree))
    made: dict[str, Any] = {}
    flags = __future__.annotations.compiler_flag
    code = compile(whole, source.__code__.co_filename, "exec", flags, dont_inherit=True)
    exec(code, source.__globals__, made)  # noqa: S102  (the kernel's own source)
    function = made[source.__name__]
    function.__qualname__ = source.__qualname__
    return function


def _parameter_fields(source: Any) -> dict[str, tuple[str, ...]]:
    """Return the fields of each parameter; none for what is no named tuple."""
    fields = _tuple_fields(source)
    return {name: fields.get(name, ()) for name in inspect.signature(source).parameters}


def _taking_tuples(compiled: Callable[..., R], takes: Mapping[str, bool]) -> Callable[..., R]:
    """Return a function with the parameters `takes` that hands on the members of those that are tuples."""
    passed = ", ".join(f"*{name}" if is_tuple else name for name, is_tuple in takes.items())
    text = f"lambda {', '.join(takes)}: compiled({passed})"
    run: Callable[..., R] = eval(text, {"compiled": compiled})  # noqa: S307  (the names of its own parameters)
    return run


_TAKES: dict[Callable[..., Any], tuple[Callable[..., Any], dict[str, bool]]] = {}
"""The compiled form of each `run` that takes named tuples, and its parameters: whether each is one."""


def bound(call: Callable[P, R], *, viewed: bool = False) -> Callable[P, R]:
    """Return ``partial(kernel.run, ...)`` as a faster call: the members of the tuples given in it are looked up once.

    The leading arguments must be given in it by position; arrays keep their identity, so what they hold may change.

    Parameters
    ----------
    viewed
        In plain Python the kernel gets :func:`views` of the given tuples; it must read and write single items only.
    """
    run, given = (call.func, call.args) if isinstance(call, partial) else (call, ())
    compiled, takes = _TAKES.get(run, (None, {}))
    if compiled is None:
        return partial(run, *[views(each) if hasattr(each, "_make") else each for each in given]) if viewed else call
    flat = [
        each
        for value, is_tuple in zip(given, takes.values(), strict=False)
        for each in (value if is_tuple else [value])
    ]
    rest = dict(list(takes.items())[len(given) :])
    leading: Callable[P, R] = partial(compiled, *flat)
    return _taking_tuples(leading, rest) if any(rest.values()) else leading


def kernel(function: Callable[P, R]) -> Kernel[P, R]:
    """Mark `function` as a kernel (see the module's docstring)."""
    return Kernel(function)


def views(arrays: Arrays) -> Arrays:
    """Return the same tuple with memory views in the place of its arrays.

    Their items are Python's own numbers, with which a kernel in plain Python takes half the time.
    """
    return arrays._make([memoryview(each) if hasattr(each, "dtype") else each for each in arrays])


@kernel
def _added(table: Array) -> float:
    total = 0.0
    for row in range(table.shape[0]):
        for column in range(table.shape[1]):
            total += table[row, column]
    return total


def sum_of(table: Array) -> float:
    """Return the sum of a table (n, k), to see whether all of it is finite; NumPy takes 2 µs for a few numbers."""
    if len(table) == 1:
        return float(sum(table[0].tolist()))
    if _compiled and table.dtype == np.float64:  # other types would be compiled first
        return _added.run(table)
    return float(np.add.reduce(table, None))


def _fingerprint() -> str:
    """Hash the sources of all kernels: numba's cache notices a change of a kernel, not of one that it calls."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        source = path.read_bytes()
        if b"@kernel" in source:
            digest.update(source)
    return digest.hexdigest()[:16]


def is_compiled() -> bool:
    """Tell whether kernels run in their compiled form here."""
    return _compiled


def compile_all() -> bool:
    """Compile all kernels, those of modules imported later included.

    Returns
    -------
    bool
        False when numba is not installed: everything still runs, slower.
    """
    global _compiled
    try:
        import numba
    except ImportError:
        return False
    if not _compiled:
        numba.config.CACHE_DIR = str(  # type: ignore[attr-defined]  # set from the environment
            platformdirs.user_cache_path("fullswarm") / f"kernels-{_fingerprint()}"
        )
    _compiled = True
    for each in _ALL:
        each.compile()
    return True
