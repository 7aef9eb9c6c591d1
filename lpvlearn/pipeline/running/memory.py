"""Results that a folder keeps, told apart by all that they depend on.

The values of the arguments, and the code: that of this library, and that of the user's
functions and classes within the arguments, which a pickle (and a hash of it) knows by
their names alone. A function is told by its bytecode and constants, what it closes
over, and what it takes from its module, functions among that likewise. Of installed
packages the version counts.
"""

from __future__ import annotations

import hashlib
import inspect
import pickle
import sys
import sysconfig
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, wraps
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

import numpy as np
import scipy
from joblib import Memory, hash
from sklearn.utils.validation import check_memory

from ...exceptions import LIBRARY, Told, repeat, retold, warn
from ...systems.whole_files import unwritten as unwritten  # the command says it, too
from ...validation import shown


def checked_memory(memory: Any, steps: dict[str, Any]) -> Memory:
    """A joblib.Memory from the argument `memory`, usable for steps (by their names)."""
    path = str(memory) if hasattr(memory, "__fspath__") else memory
    try:
        memory = check_memory(path)  # which takes a path as text only
    except ValueError as error:
        raise ValueError(
            "`memory` must be None, a folder, or a joblib.Memory. Got "
            f"{type(memory).__name__}."
        ) from error
    except OSError as error:
        told = unwritten(f"`memory` must be a folder. Got {str(memory)!r}", error)
        raise type(error)(told) from error
    if getattr(memory, "location", None) is None:
        return memory
    for name, step in steps.items():
        try:
            hash(step)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            warn(
                f"`memory` keeps nothing of this fit: its `{name}` cannot be pickled "
                f"({shown(str(error))}). Replace lambda and nested functions by "
                "functions at the top of a module, or leave `memory` out."
            )
            return Memory(None)
    return memory


@dataclass(frozen=True)
class Remembered:
    """A function whose results a store keeps by all that they depend on.

    And what is told on the way, as choices may hang on it. What ``joblib.Memory.cache``
    does, without its record of the arguments as text: joblib warns the user where
    writing that took long, as under load it may.
    """

    function: Callable[..., Any]  # at the top of a module
    store: Any  # joblib's store backend; None keeps nothing
    ignore: tuple[str, ...] = ()  # arguments that follow from the others

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """The result for these arguments: the one kept, else a new one."""
        if self.store is None:
            return self.function(*args, **kwargs)
        named = inspect.signature(self.function).bind(*args, **kwargs).arguments
        known = {name: v for name, v in named.items() if name not in self.ignore}
        try:
            key = fingerprint(known)
        except _Unknown as cause:
            warn(
                f"`memory` keeps no result that depends on {cause}, of which another "
                "version could not be told from this one. Give what it stands for as "
                "a parameter, or define it at the top of a module."
            )
            return self.function(*args, **kwargs)
        folder = f"{self.function.__module__}.{self.function.__qualname__}"
        item = [folder, key]
        if self.store.contains_item(item):
            kept = self._kept(item)
            if kept is not None:
                repeat(kept.told)
                return kept.result
            warn(
                f"`memory` holds an entry that is damaged or not its own: {folder}, "
                f"{key}. It is computed anew and replaced."
            )
        with retold() as told:
            result = self.function(*args, **kwargs)
        self.store.dump_item(item, _Kept(key, result, told), verbose=0)
        if not self.store.contains_item(item):  # joblib told why
            warn(
                f"`memory` could not keep a result in {self.store.location}: is there "
                "room, and may you write there? The work goes on without."
            )
        return result

    def _kept(self, item: list[str]) -> _Kept | None:
        try:
            kept = self.store.load_item(item, verbose=0)
        except Exception:  # whatever a damaged pickle may raise
            return None
        return kept if isinstance(kept, _Kept) and kept.key == item[1] else None


class _Kept(NamedTuple):
    """What the store holds."""

    key: str
    result: Any
    told: list[Told]

    def __reduce__(self) -> tuple[Any, ...]:
        # As bytes: joblib's own way with many small arrays is slow.
        data = pickle.dumps((self.result, self.told), pickle.HIGHEST_PROTOCOL)
        return _kept, (self.key, data)


def _kept(key: str, data: bytes) -> _Kept:
    return _Kept(key, *pickle.loads(data))  # nosec B301: of a folder that is trusted


@dataclass(frozen=True)
class RememberedElsewhere:
    """The same by an object with the interface of joblib.Memory."""

    memory: Any
    function: Callable[..., Any]
    ignore: tuple[str, ...] = ()

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """The result for these arguments: the one kept, else a new one."""
        function, anew = self.function, []

        @wraps(function)
        def beside_told(*args: Any, **kwargs: Any) -> tuple[Any, list[Told]]:
            anew.append(True)
            with retold() as told:
                return function(*args, **kwargs), told

        cached = self.memory.cache(beside_told, ignore=list(self.ignore))
        result, told = cached(*args, **kwargs)
        repeat(() if anew else told)
        return result


class _Unknown(Exception):
    """Names code that cannot be told from another version of itself."""


def fingerprint(value: Any) -> str:
    """A text that differs where a value does, or code that it leads to.

    >>> fingerprint([1, "a"]) == fingerprint([1, "a"])
    True
    >>> fingerprint({"a": 1}) == fingerprint({"a": 1.0})
    False
    """
    digest = hashlib.blake2b(_library(), digest_size=16)
    for part in _parts(value, set()):
        digest.update(part.encode() + b"\0")
    return digest.hexdigest()


@cache
def _library() -> bytes:
    """This library's code, and the versions of what it computes with."""
    digest = hashlib.blake2b(f"{np.__version__} {scipy.__version__}".encode())
    for file in sorted(LIBRARY.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.digest()


def _parts(value: Any, seen: set[int]) -> Iterator[str]:
    """What tells a value: its data, and all code within it that is not `seen` yet."""
    values = _Values()
    try:
        try:
            values.dump(value)
        except ValueError:  # parts that hold each other
            values = _Values(fast=False)
            values.dump(value)
    except Exception as error:  # an object that is no data may raise anything
        raise _Unknown(f"{value!r} ({error})") from error
    yield values.digest.hexdigest()
    for code in values.found:
        yield from _code_parts(code, seen)


class _Values(pickle.Pickler):
    """A digest of an object's values, and the functions and classes within.

    Equal values give equal digests, however they are laid out in memory, and if `fast`
    whether or not parts of them are one object.
    """

    def __init__(self, fast: bool = True) -> None:
        self.digest = hashlib.blake2b(digest_size=16)
        self.found: list[Any] = []
        super().__init__(self, pickle.HIGHEST_PROTOCOL)
        self.fast = fast  # writes what comes again, again

    def write(self, data: bytes) -> None:
        """What is pickled, as a file takes it."""
        self.digest.update(data)

    def persistent_id(self, obj: Any) -> Any:
        """What stands for code, arrays of numbers, and sets; None for the rest."""
        if isinstance(obj, FunctionType | type):
            self.found.append(obj)
            return f"{obj.__module__}.{obj.__qualname__}"
        if type(obj) in (np.ndarray, np.memmap) and not obj.dtype.hasobject:
            data = hashlib.blake2b(obj.tobytes(), digest_size=16).digest()
            return str(obj.dtype.descr), obj.shape, data
        if isinstance(obj, set | frozenset):  # whose order is one of a process
            return type(obj).__name__, sorted(map(fingerprint, obj))
        return None


def _code_parts(code: Any, seen: set[int]) -> Iterator[str]:
    """What tells a function, class or module."""
    if id(code) in seen:
        return
    seen.add(id(code))
    is_module = isinstance(code, ModuleType)
    module = code.__name__ if is_module else code.__module__
    yield f"{module}.{getattr(code, '__qualname__', '')}"
    version = _installed_version(module)
    if version is not None:
        yield version
    elif is_module:
        yield _source_of(code)
    elif isinstance(code, FunctionType):
        yield from _function_parts(code, seen)
    else:
        for base in code.__bases__:
            yield from _code_parts(base, seen)
        for name, value in sorted(vars(code).items()):
            value = getattr(value, "__func__", getattr(value, "fget", value))
            if isinstance(value, FunctionType):
                yield name
                yield from _code_parts(value, seen)
            elif not name.startswith("_") and not hasattr(value, "__get__"):
                yield name
                yield from _parts(value, seen)


def _function_parts(function: FunctionType, seen: set[int]) -> Iterator[str]:
    yield from _bytecode_parts(function.__code__)
    yield from _parts([function.__defaults__, function.__kwdefaults__], seen)
    around, names = function.__globals__, sorted(set(_names(function.__code__)))
    used = [around[name] for name in names if name in around]
    used += [cell.cell_contents for cell in function.__closure__ or ()]
    for value in used:
        if isinstance(value, FunctionType | type | ModuleType):
            yield from _code_parts(value, seen)
        else:
            yield from _parts(value, seen)


def _bytecode_parts(code: CodeType) -> Iterator[str]:
    yield f"{code.co_code!r} {code.co_names} {code.co_varnames}"
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _bytecode_parts(constant)
        elif isinstance(constant, frozenset):  # whose order is one of a process
            yield repr(sorted(map(repr, constant)))
        else:
            yield repr(constant)


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _source_of(module: ModuleType) -> str:
    try:
        return hashlib.blake2b(Path(str(module.__file__)).read_bytes()).hexdigest()
    except (AttributeError, OSError) as error:
        raise _Unknown(f"the module {module.__name__!r} ({error})") from error


def _installed_version(module: str) -> str | None:
    """Version of the package of a module, "" if unknown; None for a user's own."""
    top = module.split(".")[0]
    if top in sys.stdlib_module_names or top == LIBRARY.name:
        return ""
    package = sys.modules.get(top)
    file = getattr(package, "__file__", None)
    folders = {sysconfig.get_path(name) for name in ("purelib", "platlib")}
    if file is None or not any(Path(file).is_relative_to(f) for f in folders):
        return None
    return str(getattr(package, "__version__", ""))
