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
from pathlib import Path
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar, get_type_hints

import numpy as np
import platformdirs
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Flags = NDArray[np.bool_]
"""The arrays of the whole package: what a kernel takes and a behaviour returns."""

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
        source = _indexing(self.__wrapped__, fields) if fields else self.__wrapped__
        self.compiled = numba.njit(cache=True, error_model="numpy")(_linked(source, "compiled"))
        self.run = self.compiled
        if fields:
            entry = _entry(self.__wrapped__, self.compiled, fields)
            self.run = _flat(numba.njit(cache=True, error_model="numpy")(entry), self.__wrapped__, fields)


def _called(source: Any) -> dict[str, Kernel[Any, Any]]:
    """Return the kernels that a function names."""
    named = {name: source.__globals__.get(name) for name in source.__code__.co_names}
    return {name: other for name, other in named.items() if isinstance(other, Kernel)}


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


class _FieldsByIndex(ast.NodeTransformer):
    """Reads fields of named tuples by their index."""

    def __init__(self, fields: Mapping[str, tuple[str, ...]]) -> None:
        self._fields = fields

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        """Replace ``tuple.field`` by ``tuple[index]``."""
        if not isinstance(node.value, ast.Name) or node.attr not in self._fields.get(node.value.id, ()):
            return self.generic_visit(node)
        index = ast.Constant(self._fields[node.value.id].index(node.attr))
        return ast.copy_location(ast.Subscript(node.value, index, node.ctx), node)


def _indexing(source: Any, fields: Mapping[str, tuple[str, ...]]) -> Any:
    """Return a function that reads the fields of its named tuples by index, so that plain tuples do as well.

    Its code keeps file and lines, by which numba finds its cache and reports errors.
    """
    tree = ast.parse(textwrap.dedent(inspect.getsource(source)))
    definition = tree.body[0]
    assert isinstance(definition, ast.FunctionDef)  # noqa: S101  (a kernel is a function)
    definition.decorator_list = []
    ast.increment_lineno(tree, source.__code__.co_firstlineno - 1)
    whole = ast.fix_missing_locations(_FieldsByIndex(fields).visit(tree))
    made: dict[str, Any] = {}
    flags = __future__.annotations.compiler_flag
    code = compile(whole, source.__code__.co_filename, "exec", flags, dont_inherit=True)
    exec(code, source.__globals__, made)  # noqa: S102  (the kernel's own source)
    function = made[source.__name__]
    function.__qualname__ = source.__qualname__
    return function


def _entry(source: Any, compiled: Any, fields: Mapping[str, tuple[str, ...]]) -> Any:
    """Return a function, yet to be compiled, that takes the members of named tuples one by one and calls `compiled`.

    numba finds the type of an array in a tenth of the time that it needs for a tuple with the array in it.
    """
    names = list(inspect.signature(source).parameters)
    members = {name: [f"{name}_{k}" for k in range(len(fields[name]))] for name in names if name in fields}
    flat = ", ".join(", ".join(members.get(name, [name])) for name in names)
    passed = ", ".join(f"({', '.join(members[name])},)" if name in members else name for name in names)
    text = "\n" * (source.__code__.co_firstlineno - 1) + f"def entry({flat}): return compiled({passed})"
    made: dict[str, Any] = {}
    exec(compile(text, source.__code__.co_filename, "exec"), {"compiled": compiled}, made)  # noqa: S102  (see above)
    entry = made["entry"]
    entry.__module__, entry.__qualname__ = source.__module__, f"{source.__qualname__}.entry"
    return entry


def _flat(entry: Callable[..., R], source: Callable[P, R], fields: Mapping[str, tuple[str, ...]]) -> Callable[P, R]:
    """Return a function with the parameters of `source` that hands the members of named tuples to `entry`."""
    names = list(inspect.signature(source).parameters)
    passed = ", ".join(f"*{name}" if name in fields else name for name in names)
    run: Callable[P, R] = eval(f"lambda {', '.join(names)}: entry({passed})", {"entry": entry})  # noqa: S307  (names only)
    return run


def kernel(function: Callable[P, R]) -> Kernel[P, R]:
    """Mark `function` as a kernel (see the module's docstring)."""
    return Kernel(function)


def views(arrays: Arrays) -> Arrays:
    """Return the same tuple with memory views in the place of its arrays.

    Their items are Python's own numbers, with which a kernel in plain Python takes half the time.
    """
    return arrays._make(map(memoryview, arrays))


def _fingerprint() -> str:
    """Hash the sources of all kernels: numba's cache notices a change of a kernel, not of one that it calls."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        source = path.read_bytes()
        if b"@kernel" in source:
            digest.update(source)
    return digest.hexdigest()[:16]


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
